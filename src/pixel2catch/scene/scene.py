"""The scene as a MuJoCo model: robots, table, floor, one thrown object, camera, servos, contact sensors.

Models with different objects have the same layout; only the fields of `object_table` differ.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
from numpy import ndarray

from pixel2catch.checks import require_valid
from pixel2catch.errors import UnknownNameError
from pixel2catch.files import write_atomically
from pixel2catch.robots.spec import JointSpec
from pixel2catch.robots.workcell import VISUAL_GROUP, TableSpec, WorkcellSpec, add_robots
from pixel2catch.scene.cfg import SOLIMP, SceneCfg, contact_solref, table_solref
from pixel2catch.scene.constants import quat_multiply
from pixel2catch.scene.objects import OBJECT_BOUND, OBJECTS, ObjectSpec, num_parts
from pixel2catch.workcells import find_workcell

OBJECT_RGBA = (0.85, 0.20, 0.15, 1.0)
NO_PART = "no_part"  #: Mesh of an unused geom of the object: a tetrahedron of 1 mm at its centre.

OBJECT_START = (2.65, 0.0, 0.8)  #: Position of the object in `qpos0` [m]: the centre of the release points.

FLOOR_BIT = 2  #: Contact bit of floor and object. Robot, table and object share bit 1.

CONTACT_DATA = sum(
    1 << int(field)
    for field in (mujoco.mjtConDataField.mjCONDATA_FOUND, mujoco.mjtConDataField.mjCONDATA_DIST)
)
Contact = tuple[mujoco.mjtObj, str]
"""One side of a contact: type and name of a body, a subtree or a geom."""

REDUCE_MINDIST = 1  #: A sensor reports the deepest of several contacts.

GEOM_FIELDS = ("geom_dataid", "geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound")
BODY_FIELDS = ("body_mass", "body_subtreemass", "body_inertia", "body_invweight0")
DOF_FIELDS = ("dof_M0", "dof_length", "dof_invweight0")  #: Model fields that depend on the object.


def build_spec(cfg: SceneCfg, object_name: str = "cube_s") -> mujoco.MjSpec:
    """Compose the scene with one object."""
    if object_name not in OBJECTS:
        raise UnknownNameError("object", object_name, OBJECTS)
    workcell = find_workcell(cfg.workcell)
    spec = _spec_without_object(cfg, workcell).copy()
    _add_meshes(spec, cfg)
    _add_object(spec, cfg, OBJECTS[object_name])
    _add_contact_sensors(spec, workcell)
    if cfg.visuals:
        _add_looks(spec, workcell.table)
    return spec


@cache
def _spec_without_object(cfg: SceneCfg, workcell: WorkcellSpec) -> mujoco.MjSpec:
    """Compose the part that scenes with different objects share. Copy the result before a change."""
    spec = mujoco.MjSpec()
    spec.modelname = "pixel2catch"
    _set_options(spec, cfg)
    _add_surroundings(spec, cfg, workcell.table)
    add_robots(spec, workcell, cfg.visuals)
    _add_servos(spec, workcell.joints)
    return spec


def build_model(
    cfg: SceneCfg, object_name: str = "cube_s", armature: Mapping[str, float] | None = None
) -> mujoco.MjModel:
    """Compile the scene with one object; the layout is the same for all objects.

    `armature` overrides the nominal reflected inertias of joints, by name [kg·m²].
    """
    require_valid(cfg, "scene")
    spec = build_spec(cfg, object_name)
    for name, value in (armature or {}).items():
        spec.joint(name).armature = value
    model = spec.compile()
    _open_layout(model)
    return model


def _open_layout(model: mujoco.MjModel) -> None:
    """Reset what MuJoCo derives from one object's geoms: frame shortcuts and the bounding-volume tree."""
    body = model.body("object")
    model.geom_sameframe[model.geom_bodyid == body.id] = 0
    first = int(model.body_bvhadr[body.id])
    nodes = slice(first, first + int(model.body_bvhnum[body.id]))
    model.bvh_aabb[nodes] = (0.0, 0.0, 0.0, OBJECT_BOUND, OBJECT_BOUND, OBJECT_BOUND)


@dataclass(frozen=True, kw_only=True)
class ObjectIndices:
    """Indices of the object in the arrays of the model."""

    body: int
    geoms: slice  #: Its geoms.
    qpos: slice  #: Its position and quaternion in `qpos`.
    dofs: slice  #: Its linear and angular velocity in `qvel`.

    def rows(self, field: str) -> slice:
        """Return the rows of a model field that belong to the object."""
        if field.startswith("geom_"):
            return self.geoms
        return self.dofs if field.startswith("dof_") else slice(self.body, self.body + 1)


@dataclass(frozen=True, kw_only=True)
class ObjectTable:
    """The object's rows of every model field that depends on the object."""

    names: tuple[str, ...]  #: The objects, in the order of the first axis of each array.
    indices: ObjectIndices  #: Where the object's rows are in the arrays of the model.
    fields: dict[str, ndarray]  #: Values by model field, of the shape (num_objects, rows, ...).


def object_indices(model: mujoco.MjModel, name: str = "object") -> ObjectIndices:
    """Return the indices of the object, or of another such body, in a model."""
    body = model.body(name).id
    joint = model.joint(f"{name}_joint")
    first = int(model.body_geomadr[body])
    qpos, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
    return ObjectIndices(
        body=body,
        geoms=slice(first, first + num_parts()),
        qpos=slice(qpos, qpos + 7),
        dofs=slice(dof, dof + 6),
    )


def object_table(cfg: SceneCfg) -> ObjectTable:
    """Return the fields that differ between objects, from one model of all objects without robots."""
    return _object_table(cfg, tuple(OBJECTS.values()))


@cache
def _object_table(cfg: SceneCfg, objects: tuple[ObjectSpec, ...]) -> ObjectTable:
    spec = mujoco.MjSpec()
    _add_meshes(spec, cfg)
    for each in objects:
        _add_object(spec, cfg, each, f"object_{each.name}")
    model = spec.compile()
    found = [object_indices(model, f"object_{each.name}") for each in objects]
    fields = {
        field: np.stack([_rows(model, field, indices) for indices in found])
        for field in (*GEOM_FIELDS, *BODY_FIELDS, *DOF_FIELDS)
    }
    indices = object_indices(build_model(cfg, objects[0].name))
    return ObjectTable(names=tuple(each.name for each in objects), indices=indices, fields=fields)


def _rows(model: mujoco.MjModel, field: str, indices: ObjectIndices) -> ndarray:
    values = getattr(model, field)
    return np.array(values.reshape(len(values), -1) if values.ndim > 2 else values)[indices.rows(field)]


def export(path: Path, cfg: SceneCfg, object_name: str = "cube_s") -> None:
    """Write the model as a self-contained .xml with six digits, else as an exact binary, .mjb."""
    if path.suffix.lower() == ".xml":
        spec = build_spec(cfg, object_name)
        spec.compile()
        write_atomically({path: spec.to_xml()})
    else:
        model = build_model(cfg, object_name)
        mujoco.mj_saveModel(model, None, content := np.empty(mujoco.mj_sizeModel(model), np.uint8))
        write_atomically({path: content.tobytes()})


def _set_options(spec: mujoco.MjSpec, cfg: SceneCfg) -> None:
    """Set solver options. Source: ours, by drops and throws on table and palm (experiments/LOG.md).

    The "discrete" integrator removes restitution. Speculative contacts halve it, and Warp does not have them.
    """
    spec.compiler.degree = False
    option = spec.option
    option.timestep = cfg.physics_dt
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{cfg.cone.upper()}")
    if not cfg.multiccd:
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    option.iterations = 10
    option.ls_iterations = 50  # MuJoCo's default; with 20 one contact step in 2,000 does not converge


def _add_surroundings(spec: mujoco.MjSpec, cfg: SceneCfg, table: TableSpec) -> None:
    """Add floor, table and camera; floor and table are separate bodies for the broad phase."""
    world = spec.worldbody
    world.add_body(name="floor").add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(4, 4, 0.1),
        rgba=(0.55, 0.57, 0.60, 1),
        contype=FLOOR_BIT,
        conaffinity=FLOOR_BIT,
    )
    x, y, top = table.center
    half = (table.size[0] / 2, table.size[1] / 2, table.thickness / 2)
    pos = (x, y, top - half[2])
    world.add_body(name="table").add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=pos,
        size=half,
        rgba=(0.66, 0.50, 0.34, 1),
        priority=1,
        solref=table_solref(cfg.physics_dt),
        solimp=SOLIMP,
    )
    camera = cfg.camera
    world.add_camera(
        name="rgb",
        pos=camera.pos,
        quat=quat_multiply(camera.quat, (0.0, 1.0, 0.0, 0.0)),
        resolution=(camera.width, camera.height),
        sensor_size=(camera.width * 1e-5, camera.height * 1e-5),
        focal_pixel=(camera.fx, camera.fy),
        principal_pixel=(camera.width / 2 - camera.cx, camera.height / 2 - camera.cy),  # sign of the renderer
    )


def _add_servos(spec: mujoco.MjSpec, joints: tuple[JointSpec, ...]) -> None:
    """Add limits, friction and a position servo for every joint, in joint order.

    torque = stiffness (target - position) - damping velocity, limited to the effort of the servo.
    """
    for each in joints:
        joint = spec.joint(each.name)
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = (each.lower, each.upper)
        joint.frictionloss = each.frictionloss
        joint.armature = each.armature
        spec.add_actuator(
            name=each.name,
            target=each.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            gainprm=[each.stiffness, *[0.0] * 9],
            biasprm=[0.0, -each.stiffness, -each.damping, *[0.0] * 7],
            ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            ctrlrange=(each.lower, each.upper),
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=(-each.effort_limit, each.effort_limit),
        )


def _add_meshes(spec: mujoco.MjSpec, cfg: SceneCfg) -> None:
    for each in OBJECTS.values():
        for i, part in enumerate(each.scaled(cfg.object_scale).parts):
            spec.add_mesh(name=f"{each.name}_part_{i}", uservert=part.vertices.ravel())
    corners = 5e-4 * np.array(((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)))
    spec.add_mesh(name=NO_PART, uservert=corners.ravel())


def _add_object(spec: mujoco.MjSpec, cfg: SceneCfg, thrown: ObjectSpec, name: str = "object") -> None:
    thrown = thrown.scaled(cfg.object_scale)
    body = spec.worldbody.add_body(name=name, pos=OBJECT_START)
    body.add_freejoint(name=f"{name}_joint")
    body.explicitinertial = True
    body.mass = thrown.mass
    body.ipos, body.iquat = (0, 0, 0), (1, 0, 0, 0)  # MuJoCo's default is the pose of the body
    body.inertia = thrown.inertia
    for i in range(num_parts()):
        body.add_geom(
            name=f"{name}_part_{i}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"{thrown.name}_part_{i}" if i < len(thrown.parts) else NO_PART,
            rgba=OBJECT_RGBA,
            group=1,
            contype=1 | FLOOR_BIT,
            conaffinity=1 | FLOOR_BIT,
            condim=3,
            priority=2,
            friction=(cfg.object_friction, 0.005, 0.0001),
            solref=contact_solref(cfg.object_restitution, cfg.physics_dt),
            solimp=SOLIMP,
        )


def contact_sensors(workcell: WorkcellSpec) -> dict[str, tuple[Contact, Contact | None]]:
    """Return the two sides of each contact sensor, by the name of the sensor.

    There are sensors for the object with each palm, each finger and anything, for each robot with the table
    and with itself, and for each pair of robots.
    """
    subtree, body = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_BODY
    thrown, table = (body, "object"), (mujoco.mjtObj.mjOBJ_GEOM, "table")
    sensors: dict[str, tuple[Contact, Contact | None]] = {}
    for palm in workcell.palms:
        sensors[f"object_{palm.spec.name}"] = thrown, (body, palm.spec.body)
        for finger in palm.spec.fingers:
            sensors[f"object_{finger.name}"] = thrown, (subtree, finger.root)
    sensors["object_any"] = thrown, None
    robots = {f"{each.prefix}robot": (subtree, each.prefix + each.robot.root) for each in workcell.robots}
    sensors |= {f"{name}_table": (root, table) for name, root in robots.items()}
    sensors |= {f"{name}_self": (root, root) for name, root in robots.items()}
    sensors |= {f"{one}_{other}": (robots[one], robots[other]) for one, other in combinations(robots, 2)}
    return sensors


def _add_contact_sensors(spec: mujoco.MjSpec, workcell: WorkcellSpec) -> None:
    """Add sensors with (found, dist [m]) of the deepest contact between two sides."""
    for name, (first, second) in contact_sensors(workcell).items():
        sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = first
        if second is not None:
            sensor.reftype, sensor.refname = second
        sensor.intprm = (CONTACT_DATA, REDUCE_MINDIST, 1)


def _add_looks(spec: mujoco.MjSpec, table: TableSpec) -> None:
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = (0.35,) * 3, (0.35,) * 3, (0.1,) * 3
    spec.visual.map.znear, spec.visual.map.shadowclip = 0.02, 2.0
    spec.stat.extent, spec.stat.center = 2.0, (0.4, 0.0, 1.0)
    for pos, direction, strength, has_shadow in (
        ((1.0, -1.2, 3.6), (-0.25, 0.4, -1.0), 0.55, True),
        ((-1.5, 2.0, 3.0), (0.5, -0.6, -1.0), 0.25, False),
    ):
        spec.worldbody.add_light(
            pos=pos,
            dir=direction,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            diffuse=(strength,) * 3,
            specular=(0.15,) * 3,
            castshadow=has_shadow,
        )
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    for name, kind, pattern, rgb1, rgb2 in (
        ("sky", texture.mjTEXTURE_SKYBOX, builtin.mjBUILTIN_GRADIENT, (0.62, 0.72, 0.82), (0.93, 0.95, 0.97)),
        ("floor", texture.mjTEXTURE_2D, builtin.mjBUILTIN_CHECKER, (0.50, 0.53, 0.56), (0.58, 0.61, 0.64)),
    ):
        spec.add_texture(name=name, type=kind, builtin=pattern, rgb1=rgb1, rgb2=rgb2, width=256, height=256)
    material = spec.add_material(name="floor", texrepeat=(1, 1), texuniform=True, specular=0.1, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    floor = spec.geom("floor")
    floor.size, floor.material, floor.rgba = (0, 0, 0.1), "floor", (1, 1, 1, 1)  # size 0: infinite
    floor.castshadow = False  # avoids speckles
    x, y, top = table.center
    height = top - table.thickness
    spec.worldbody.add_geom(  # a pedestal under the table
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(x, y, height / 2),
        size=(table.size[0] / 2 - 0.05, table.size[1] / 2 - 0.05, height / 2),
        rgba=(0.32, 0.33, 0.35, 1.0),
        group=VISUAL_GROUP,
        contype=0,
        conaffinity=0,
    )
