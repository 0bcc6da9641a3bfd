"""The scene as a MuJoCo model: robot, table, floor, one thrown object, camera, servos, contact sensors.

The model of every object has the same layout; only the values of a few fields differ (`object_table.py`).
"""

from collections.abc import Mapping
from itertools import combinations
from os import PathLike
from pathlib import Path

import mujoco
import numpy as np

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.robots.spec import JointSpec
from pixel2catch.robots.workcell import TableSpec, WorkcellSpec, add_robots
from pixel2catch.scene.cfg import SceneCfg
from pixel2catch.scene.constants import quat_multiply
from pixel2catch.scene.contact import SOLIMP, contact_solref, table_solref
from pixel2catch.scene.objects import MAX_PARTS, OBJECTS, ObjectSpec
from pixel2catch.scene.surroundings import add_looks
from pixel2catch.workcells import find_workcell

OBJECT_RGBA = (0.85, 0.20, 0.15, 1.0)
NO_PART = "no_part"
"""Mesh that takes the place of the second part of a one-part object: a tetrahedron of 1 mm in its middle."""

OBJECT_START = (2.65, 0.0, 0.8)
"""Position of the object in `qpos0` [m]: the middle of the throw's release points."""

FLOOR_BIT = 2
"""Contact bit of the floor: only the object falls on it. Robot, table and object share bit 1."""

OBJECT_BOUND = 0.1
"""Half an edge of a cube about the body origin that holds every object [m]."""

CONTACT_DATA = sum(
    1 << int(field)
    for field in (mujoco.mjtConDataField.mjCONDATA_FOUND, mujoco.mjtConDataField.mjCONDATA_DIST)
)
Contact = tuple[mujoco.mjtObj, str]
"""One side of a contact: a body, a body with all that hangs on it, or a geom, by name."""

REDUCE_MINDIST = 1
"""Of several contacts a sensor reports the deepest."""


def build_spec(cfg: SceneCfg, object_name: str = "cube_s") -> mujoco.MjSpec:
    """Compose the scene with one object.

    Raises:
        UnknownNameError: If the object is not in the catalogue, or a choice is none of those there are.
    """
    if object_name not in OBJECTS:
        raise UnknownNameError("object", object_name, OBJECTS)
    workcell = find_workcell(cfg.workcell)
    spec = mujoco.MjSpec()
    spec.modelname = "pixel2catch"
    _set_options(spec, cfg)
    _add_surroundings(spec, cfg, workcell.table)
    add_robots(spec, workcell, cfg.visuals)
    _add_servos(spec, workcell.joints)
    _add_object(spec, cfg, OBJECTS[object_name])
    _add_contact_sensors(spec, workcell)
    if cfg.visuals:
        add_looks(spec, workcell.table)
    return spec


def build_model(
    cfg: SceneCfg, object_name: str = "cube_s", armature: Mapping[str, float] | None = None
) -> mujoco.MjModel:
    """Compile the scene with one object; the layout is the same for all, so that fields can be exchanged.

    `armature` are reflected inertias by joint that differ from the nominal ones [kg·m²].
    """
    spec = build_spec(cfg, object_name)
    for name, value in (armature or {}).items():
        spec.joint(name).armature = value
    model = spec.compile()
    _open_layout(model)
    return model


def _open_layout(model: mujoco.MjModel) -> None:
    """Undo what MuJoCo derives from one object's geoms: shortcuts of frames, and a bounding-volume tree."""
    body = model.body("object")
    model.geom_sameframe[model.geom_bodyid == body.id] = 0
    first = int(model.body_bvhadr[body.id])
    nodes = slice(first, first + int(model.body_bvhnum[body.id]))
    model.bvh_aabb[nodes] = (0.0, 0.0, 0.0, OBJECT_BOUND, OBJECT_BOUND, OBJECT_BOUND)


def export(path: str | PathLike[str], cfg: SceneCfg, object_name: str = "cube_s") -> None:
    """Write the model as a self-contained .xml, of six digits, or as an exact, binary .mjb.

    Raises:
        InvalidValueError: If the path ends otherwise.
    """
    spec = build_spec(cfg, object_name)
    model = spec.compile()
    _open_layout(model)
    suffix = Path(path).suffix
    if suffix == ".xml":
        Path(path).write_text(spec.to_xml(), encoding="utf-8")
    elif suffix == ".mjb":
        mujoco.mj_saveModel(model, str(path))
    else:
        raise InvalidValueError(f"cannot export to '{path}': the name must end in .xml or .mjb.")


def _set_options(spec: mujoco.MjSpec, cfg: SceneCfg) -> None:
    """Solver options. Source: ours, `benchmarks/contact_quality.py`.

    The "discrete" integrator damps restitution away; speculative contacts halve it, and Warp lacks them.
    """
    spec.compiler.degree = False
    option = spec.option
    option.timestep = cfg.physics_dt
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.iterations = 10
    option.ls_iterations = 20


def _add_surroundings(spec: mujoco.MjSpec, cfg: SceneCfg, table: TableSpec) -> None:
    """Floor, table and the camera; floor and table are bodies of their own, for the broad phase."""
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
        principal_pixel=(camera.width / 2 - camera.cx, camera.height / 2 - camera.cy),  # the renderer's sign
    )


def _add_servos(spec: mujoco.MjSpec, joints: tuple[JointSpec, ...]) -> None:
    """Limits, friction and a position servo for every joint, in the order of the joints."""
    for joint_spec in joints:
        joint = spec.joint(joint_spec.name)
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = (joint_spec.lower, joint_spec.upper)
        joint.frictionloss = joint_spec.frictionloss
        joint.armature = joint_spec.armature
        _add_servo(spec, joint_spec)


def _add_servo(spec: mujoco.MjSpec, joint: JointSpec) -> None:
    """Torque = stiffness (target - position) - damping velocity, limited to the effort of the servo."""
    gain, bias = np.zeros(10), np.zeros(10)
    gain[0] = joint.stiffness
    bias[1], bias[2] = -joint.stiffness, -joint.damping
    spec.add_actuator(
        name=joint.name,
        target=joint.name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=gain,
        biasprm=bias,
        ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        ctrlrange=(joint.lower, joint.upper),
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=(-joint.effort_limit, joint.effort_limit),
    )


def _add_object(spec: mujoco.MjSpec, cfg: SceneCfg, thrown: ObjectSpec) -> None:
    """The thrown object on a free joint; the meshes of all other objects are in the model, too."""
    thrown = thrown.scaled(cfg.object_scale)
    for other in OBJECTS.values():
        for i, part in enumerate(other.scaled(cfg.object_scale).parts):
            spec.add_mesh(name=f"{other.name}_part_{i}", uservert=part.vertices.ravel())
    corners = 5e-4 * np.array(((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)))
    spec.add_mesh(name=NO_PART, uservert=corners.ravel())
    body = spec.worldbody.add_body(name="object", pos=OBJECT_START)
    body.add_freejoint(name="object_joint")
    body.explicitinertial = True
    body.mass = thrown.mass
    body.ipos, body.iquat = (0, 0, 0), (1, 0, 0, 0)  # left unset, MuJoCo takes the body's pose for them
    body.inertia = thrown.inertia
    for i in range(MAX_PARTS):
        body.add_geom(
            name=f"object_part_{i}",
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
            solimp=cfg.object_solimp,
        )


def contact_sensors(workcell: WorkcellSpec) -> tuple[str, ...]:
    """Names of the contact sensors.

    Each palm and its fingers with the object, anything with it, then each robot with the table, each with
    itself, and each with each other one.
    """
    parts = [
        name
        for palm in workcell.palms
        for name in (palm.spec.name, *(finger.name for finger in palm.spec.fingers))
    ]
    robots = [placed.prefix + "robot" for placed in workcell.robots]
    pairs = [f"{first}_{second}" for first, second in combinations(robots, 2)]
    return (
        *(f"object_{part}" for part in parts),
        "object_any",
        *(f"{robot}_table" for robot in robots),
        *(f"{robot}_self" for robot in robots),
        *pairs,
    )


def _add_contact_sensors(spec: mujoco.MjSpec, workcell: WorkcellSpec) -> None:
    """The sensors, in the order of `contact_sensors`."""
    subtree, body = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_BODY
    thrown, table = (body, "object"), (mujoco.mjtObj.mjOBJ_GEOM, "table")
    pairs: list[tuple[Contact, Contact | None]] = []
    for palm in workcell.palms:
        pairs.append((thrown, (body, palm.spec.body)))
        pairs += [(thrown, (subtree, finger.root)) for finger in palm.spec.fingers]
    roots = [(subtree, root) for root in workcell.roots]
    pairs += [(thrown, None), *((root, table) for root in roots), *((root, root) for root in roots)]
    pairs += combinations(roots, 2)
    for name, (first, second) in zip(contact_sensors(workcell), pairs, strict=True):
        _add_sensor(spec, name, first, second)


def _add_sensor(spec: mujoco.MjSpec, name: str, first: Contact, second: Contact | None) -> None:
    """A sensor of (found, dist [m]) of the deepest contact between two bodies, subtrees or geoms."""
    sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
    sensor.objtype, sensor.objname = first
    if second is not None:
        sensor.reftype, sensor.refname = second
    sensor.intprm = (CONTACT_DATA, REDUCE_MINDIST, 1)
