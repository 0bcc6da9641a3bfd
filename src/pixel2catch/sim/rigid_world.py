"""A MuJoCo model as rigid bodies, joints and shapes, from which other engines are built.

Bodies without a joint belong to the body that they are fixed to. A model element without a counterpart here
is refused by name, so that no engine ignores it silently.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.poses import Pose, combined, inertial_of, pose_of, principal_axes, vertices_of
from pixel2catch.scene.cfg import restitution_of

REFUSED = (
    *("neq", "ntendon", "nflex", "nhfield", "npair", "nmocap"),
    *("dof_damping", "dof_frictionloss", "jnt_stiffness"),
)
"""Counts and fields of a model that must be 0, as other engines have no counterpart."""


@dataclass(frozen=True, kw_only=True)
class Geom:
    """A collision shape."""

    type: mujoco.mjtGeom  #: Plane, box, sphere, capsule, cylinder, or mesh for a convex hull.
    size: Float[ndarray, "3"]  #: As in MuJoCo [m].
    vertices: Float[ndarray, "num_vertices 3"]  #: Of a convex hull [m]; empty for other shapes.
    pose: Pose  #: In the frame of its body.
    contype: int  #: Contact bits.
    conaffinity: int  #: Contact bits of other shapes with which it collides.


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A hinge between a body and its parent."""

    axis: Float[ndarray, "3"]  #: In the frame of the body, of length 1.
    pos: Float[ndarray, "3"]  #: A point on the axis in that frame [m].
    limits: tuple[float, float]  #: Smallest and largest angle [rad].
    armature: float  #: Reflected inertia [kg·m²].
    actuator: int  #: Index of its servo in `ctrl`.
    stiffness: float  #: Stiffness of its servo [N·m/rad].
    damping: float  #: Damping of its servo [N·m·s/rad].
    effort_limit: float  #: Largest torque [N·m].


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid body: bodies of the model that are fixed to each other."""

    number: int  #: Number of its first body in the model.
    parent: int  #: Number of its parent body; 0 is the world.
    pose: Pose  #: In the frame of its parent, at the model's reference position.
    joint: Joint | None  #: Its hinge; None for a body that moves freely.
    qpos: int  #: Index of its angle, or of its position and quaternion, in `qpos`.
    dof: int  #: Index of its speed in `qvel`.
    mass: float  #: Mass [kg].
    inertial_pose: Pose  #: Frame of its principal axes of inertia.
    inertia: Float[ndarray, "3"]  #: Principal moments of inertia [kg·m²].
    has_weight: bool  #: Whether gravity acts on it.
    geoms: tuple[Geom, ...]


@dataclass(frozen=True, kw_only=True)
class RigidWorld:
    """Bodies, shapes and contact parameters of a simulation."""

    bodies: tuple[Body, ...]  #: The moving bodies, parents first.
    #: Fixed shapes by the number of the first moving body on them; 0 for all others.
    fixed: dict[int, tuple[Geom, ...]]
    excluded: tuple[tuple[int, int], ...]  #: Pairs of bodies that do not collide, by number.
    gravity: Float[ndarray, "3"]  #: Gravity [m/s²].
    timestep: float  #: Physics time step [s].
    friction: float  #: Sliding friction of the geoms with the highest priority.
    restitution: float  #: Speed after over speed before an impact of these geoms.


def rigid_world(model: mujoco.MjModel) -> RigidWorld:
    """Read the rigid bodies of a compiled model; raise InvalidValueError for what has no counterpart.

    Friction and restitution are those of the geoms with the highest priority, as in their MuJoCo contacts.
    """
    _refuse(model)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
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


def turned_onto(axis: Float[ndarray, "3"]) -> Pose:
    """Return a frame at the origin whose x axis is a given axis of length 1."""
    second = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    second /= np.linalg.norm(second)
    return pose_of(np.zeros(3), np.column_stack((axis, second, np.cross(axis, second))))


def _refuse(model: mujoco.MjModel) -> None:
    is_hinge = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
    is_servo = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = sorted(model.actuator_trnid[is_servo, 0].tolist())
    faults = {name: np.any(getattr(model, name)) for name in REFUSED} | {
        "joints other than hinges": (model.jnt_type[~is_hinge] != int(mujoco.mjtJoint.mjJNT_FREE)).any(),
        "bodies with several joints": (model.body_jntnum > 1).any(),
        "a gravcomp between 0 and 1": ~np.isin(model.body_gravcomp, (0.0, 1.0)).all(),
        "joints without one servo each": not is_servo.all() or driven != np.flatnonzero(is_hinge).tolist(),
        "servos without limits": not model.actuator_ctrllimited.all()
        or not model.actuator_forcelimited.all(),
        "signed distance fields": (model.geom_type > int(mujoco.mjtGeom.mjGEOM_MESH)).any(),
        "ellipsoids": (model.geom_type == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)).any(),
        "a reference angle other than 0": model.qpos0[model.jnt_qposadr[is_hinge]].any(),
    }
    if found := [name for name, is_there in faults.items() if is_there]:
        raise InvalidValueError(f"only engine 'mujoco' supports {', '.join(found)} of the model; use it.")


def _body(model: mujoco.MjModel, data: mujoco.MjData, number: int) -> Body:
    """Return the rigid body that begins with a body of the model."""
    members = np.flatnonzero(model.body_weldid == number)
    parent = int(model.body_weldid[model.body_parentid[number]])
    poses = {body: pose_of(data.xpos[body], data.xmat[body]) for body in (parent, *members.tolist())}
    origin = poses[number]
    mass, center, inertia = combined(
        [inertial_of(model, body, np.linalg.inv(origin) @ poses[body]) for body in members.tolist()]
    )
    moments, axes = principal_axes(inertia)
    joint = int(model.body_jntadr[number])
    is_free = model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE)
    return Body(
        number=number,
        parent=parent,
        pose=np.linalg.inv(poses[parent]) @ origin,
        joint=None if is_free else _joint(model, joint),
        qpos=int(model.jnt_qposadr[joint]),
        dof=int(model.jnt_dofadr[joint]),
        mass=mass,
        inertial_pose=pose_of(center, axes),
        inertia=moments,
        has_weight=not model.body_gravcomp[members].any(),
        geoms=_geoms(model, data, members, origin),
    )


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
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    return tuple(
        Geom(
            type=mujoco.mjtGeom(model.geom_type[geom]),
            size=np.array(model.geom_size[geom]),
            vertices=vertices_of(model, geom),
            pose=np.linalg.inv(origin) @ pose_of(data.geom_xpos[geom], data.geom_xmat[geom]),
            contype=int(model.geom_contype[geom]),
            conaffinity=int(model.geom_conaffinity[geom]),
        )
        for geom in np.flatnonzero(collides & np.isin(model.geom_bodyid, bodies)).tolist()
    )


def _fixed(
    model: mujoco.MjModel, data: mujoco.MjData, bodies: tuple[Body, ...]
) -> dict[int, tuple[Geom, ...]]:
    """Return the fixed shapes: those of each robot by its first moving body, and the rest."""
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
    pairs = [(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature]
    welded = [tuple(int(model.body_weldid[body]) for body in pair) for pair in pairs]
    return tuple((one, other) for one, other in welded if one and other)
