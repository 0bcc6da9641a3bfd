"""A MuJoCo model as rigid bodies, joints and shapes: what every other engine is built from.

Bodies without a joint belong to the body that they are fixed to. What of a model has no counterpart here is
refused by name, so that no engine leaves it out silently.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.maker import directions
from pixel2catch.scene.cfg import restitution_of

Pose = Float[ndarray, "4 4"]
"""A frame in another one: rotation and position [m] as a homogeneous matrix."""

ELLIPSOID_POINTS = 200
"""Points of the convex hull that takes the place of an ellipsoid. Source: ours; PhysX takes at most 255."""

REFUSED = ("neq", "ntendon", "nflex", "nhfield", "npair", "nmocap")
"""Counts of what no engine here is given."""


@dataclass(frozen=True, kw_only=True)
class Geom:
    """A shape that collides."""

    type: mujoco.mjtGeom  #: Plane, box, sphere, capsule, cylinder, or mesh for a convex hull.
    size: Float[ndarray, "3"]  #: As in MuJoCo [m].
    vertices: Float[ndarray, "num_vertices 3"]  #: Of a convex hull [m]; of others none.
    pose: Pose  #: Where it is in its body.
    contype: int  #: Contact bits.
    conaffinity: int  #: What of others' contact bits it collides with.


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A hinge between a body and its parent."""

    axis: Float[ndarray, "3"]  #: In the frame of the body, of length 1.
    pos: Float[ndarray, "3"]  #: A point of the axis in that frame [m].
    limits: tuple[float, float]  #: Smallest and largest angle [rad].
    armature: float  #: Reflected inertia [kg·m²].
    actuator: int  #: Row of its servo in `ctrl`.
    stiffness: float  #: Of its servo [N·m/rad].
    damping: float  #: Of its servo [N·m·s/rad].
    effort_limit: float  #: Largest torque [N·m].


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid body: those of the model that are fixed to each other."""

    number: int  #: Of its first body in the model.
    parent: int  #: Number of the body that carries it; 0 is the world.
    pose: Pose  #: Where it is in its parent at the model's reference position.
    joint: Joint | None  #: How it turns; a body without moves freely.
    qpos: int  #: Where its angle, or its position and quaternion, begins in `qpos`.
    dof: int  #: Where its speed begins in `qvel`.
    mass: float  #: [kg].
    inertial_pose: Pose  #: Its principal axes of inertia.
    inertia: Float[ndarray, "3"]  #: About these [kg·m²].
    has_weight: bool  #: Whether gravity pulls at it.
    geoms: tuple[Geom, ...]


@dataclass(frozen=True, kw_only=True)
class RigidWorld:
    """Everything that an engine simulates."""

    bodies: tuple[Body, ...]  #: Those that move, parents first.
    #: What stands still, by the number of the body that moves on it; 0 is under nothing.
    fixed: dict[int, tuple[Geom, ...]]
    excluded: tuple[tuple[int, int], ...]  #: Pairs of bodies that do not collide, by number.
    gravity: Float[ndarray, "3"]  #: [m/s²].
    timestep: float  #: [s].
    friction: float  #: Sliding friction of the surfaces that decide a contact.
    restitution: float  #: Speed after over speed before an impact of theirs.


def rigid_world(model: mujoco.MjModel) -> RigidWorld:
    """Read the rigid bodies of a compiled model.

    The surfaces are those of the geoms of highest priority, which decide every contact of theirs.

    Raises:
        InvalidValueError: If there is something in the model that has no counterpart.
    """
    _refuse(model)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    moving = [body for body in range(1, model.nbody) if model.body_weldid[body] == body]
    bodies = tuple(_body(model, data, body) for body in moving)
    first = int(np.argmax(model.geom_priority))
    return RigidWorld(
        bodies=bodies,
        fixed=_fixed(model, data, bodies),
        excluded=_excluded(model),
        gravity=np.array(model.opt.gravity),
        timestep=model.opt.timestep,
        friction=float(model.geom_friction[first, 0]),
        restitution=restitution_of(model.geom_solref[first], model.opt.timestep),
    )


def pose_of(pos: ndarray, rotation: ndarray) -> Pose:
    """The homogeneous matrix of a position [m] and a rotation matrix, of which rows may be flat."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), pos
    return pose


def quat_of(pose: Pose) -> Float[ndarray, "4"]:
    """The quaternion (w, x, y, z) of a pose."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, pose[:3, :3].ravel())
    return quat


def rotation_of(quat: Float[ndarray, "4"]) -> Float[ndarray, "3 3"]:
    """The rotation matrix of a quaternion (w, x, y, z)."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.ascontiguousarray(quat))
    return rotation.reshape(3, 3)


def turned_onto(axis: Float[ndarray, "3"]) -> Pose:
    """A frame at the origin whose x axis lies along this axis, of length 1."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    second = np.cross(axis, other)
    second /= np.linalg.norm(second)
    return pose_of(np.zeros(3), np.column_stack((axis, second, np.cross(axis, second))))


def _refuse(model: mujoco.MjModel) -> None:
    found = [name for name in REFUSED if getattr(model, name)]
    hinge, free = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_FREE)
    found += [
        f"joint '{model.joint(i).name}'" for i, kind in enumerate(model.jnt_type) if kind not in (hinge, free)
    ]
    found += [
        f"body '{model.body(i).name}' with several joints" for i in np.flatnonzero(model.body_jntnum > 1)
    ]
    servos = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = sorted(model.actuator_trnid[servos, 0].tolist())
    if not servos.all() or driven != np.flatnonzero(model.jnt_type == hinge).tolist():
        found.append("joints without one servo each")
    found += [
        f"gravcomp of body '{model.body(i).name}'"
        for i, g in enumerate(model.body_gravcomp)
        if g not in (0, 1)
    ]
    if not (model.actuator_ctrllimited.all() and model.actuator_forcelimited.all()):
        found.append("servos without limits")
    for name in ("dof_damping", "dof_frictionloss", "jnt_stiffness"):
        if getattr(model, name).any():
            found.append(name)
    if (model.geom_type > int(mujoco.mjtGeom.mjGEOM_MESH)).any():
        found.append("signed distance fields")
    if model.qpos0[model.jnt_qposadr[model.jnt_type == hinge]].any():
        found.append("a reference angle other than 0")
    if found:
        raise InvalidValueError(
            f"the model has {', '.join(found)}, which other engines are not given; use engine 'mujoco'."
        )


def _body(model: mujoco.MjModel, data: mujoco.MjData, number: int) -> Body:
    """The rigid body that begins with a body of the model."""
    members = np.flatnonzero(model.body_weldid == number)
    origin = pose_of(data.xpos[number], data.xmat[number])
    parent = int(model.body_weldid[model.body_parentid[number]])
    carrier = pose_of(data.xpos[parent], data.xmat[parent])
    mass, center, inertia = _inertia(model, data, members, origin)
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    joint = int(model.body_jntadr[number])
    is_free = model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE)
    return Body(
        number=number,
        parent=parent,
        pose=np.linalg.inv(carrier) @ origin,
        joint=None if is_free else _joint(model, joint),
        qpos=int(model.jnt_qposadr[joint]),
        dof=int(model.jnt_dofadr[joint]),
        mass=mass,
        inertial_pose=pose_of(center, axes),
        inertia=moments,
        has_weight=not model.body_gravcomp[members].any(),
        geoms=_geoms(model, data, members, origin),
    )


def _inertia(
    model: mujoco.MjModel, data: mujoco.MjData, members: ndarray, origin: Pose
) -> tuple[float, Float[ndarray, "3"], Float[ndarray, "3 3"]]:
    """Mass [kg], centre [m] and inertia about it [kg·m²] of bodies together, in a frame."""
    mass = model.body_mass[members]
    center = mass @ data.xipos[members] / mass.sum()
    total = np.zeros((3, 3))
    for body, share in zip(members, mass, strict=True):
        axes, arm = data.ximat[body].reshape(3, 3), data.xipos[body] - center
        total += axes @ np.diag(model.body_inertia[body]) @ axes.T
        total += share * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    rotation = origin[:3, :3]
    return float(mass.sum()), rotation.T @ (center - origin[:3, 3]), rotation.T @ total @ rotation


def _joint(model: mujoco.MjModel, joint: int) -> Joint:
    actuator = int(np.flatnonzero(model.actuator_trnid[:, 0] == joint)[0])
    low, high = model.jnt_range[joint].tolist()
    return Joint(
        axis=np.array(model.jnt_axis[joint]),
        pos=np.array(model.jnt_pos[joint]),
        limits=(low, high),
        armature=float(model.dof_armature[model.jnt_dofadr[joint]]),
        actuator=actuator,
        stiffness=float(model.actuator_gainprm[actuator, 0]),
        damping=-float(model.actuator_biasprm[actuator, 2]),
        effort_limit=float(model.actuator_forcerange[actuator, 1]),
    )


def _geoms(model: mujoco.MjModel, data: mujoco.MjData, bodies: ndarray, origin: Pose) -> tuple[Geom, ...]:
    """The shapes of bodies that collide, in a frame."""
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    return tuple(
        _geom(model, geom, np.linalg.inv(origin) @ pose_of(data.geom_xpos[geom], data.geom_xmat[geom]))
        for geom in np.flatnonzero(collides & np.isin(model.geom_bodyid, bodies)).tolist()
    )


def _geom(model: mujoco.MjModel, geom: int, pose: Pose) -> Geom:
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), np.array(model.geom_size[geom])
    vertices = np.zeros((0, 3))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        vertices = np.array(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], dtype=float)
    elif kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        kind, vertices = mujoco.mjtGeom.mjGEOM_MESH, size * directions(ELLIPSOID_POINTS)
    return Geom(
        type=kind,
        size=size,
        vertices=vertices,
        pose=pose,
        contype=int(model.geom_contype[geom]),
        conaffinity=int(model.geom_conaffinity[geom]),
    )


def _fixed(
    model: mujoco.MjModel, data: mujoco.MjData, bodies: tuple[Body, ...]
) -> dict[int, tuple[Geom, ...]]:
    """What stands still: of each robot under its first body that moves, and the rest."""
    still = set(np.flatnonzero(model.body_weldid == 0).tolist())
    fixed = {}
    for body in bodies:
        if body.joint is not None and body.parent == 0:
            pedestal, under = set(), int(model.body_parentid[body.number])
            while under in still and under:
                pedestal.add(under)
                under = int(model.body_parentid[under])
            fixed[body.number] = _geoms(model, data, np.array(sorted(pedestal), dtype=int), np.eye(4))
            still -= pedestal
    return {0: _geoms(model, data, np.array(sorted(still)), np.eye(4)), **fixed}


def _excluded(model: mujoco.MjModel) -> tuple[tuple[int, int], ...]:
    """Pairs that the model names, apart from those of neighbours and of what does not move."""
    pairs = [(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature]
    welded = [tuple(int(model.body_weldid[body]) for body in pair) for pair in pairs]
    return tuple((one, other) for one, other in welded if one and other)
