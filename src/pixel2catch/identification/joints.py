"""What this room reads from a work cell: its joints by name, the parts that can be identified, its models."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import mujoco
import numpy as np
from jaxtyping import Bool, Int

from pixel2catch.errors import UnknownNameError
from pixel2catch.robots.spec import JointGroup, JointSpec
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import SPEED_MARGIN
from pixel2catch.scene.scene import SceneCfg, build_spec


@dataclass(frozen=True, kw_only=True)
class MotionRange:
    """How far joints of a role get, and how they are excited."""

    reach: float  #: no joint gets so far from 0 [rad]
    margin: float  #: distance that commands of an excitation keep from a joint's limits [rad]
    swing: float  #: farthest from the middle of the excitation [rad]
    acceleration: float  #: largest acceleration of its smooth commands [rad/s²]


MOTION_RANGES = {
    "arm": MotionRange(reach=2.0 * pi + 0.1, margin=0.03, swing=0.35, acceleration=15.0),
    "hand": MotionRange(reach=pi, margin=0.06, swing=0.4, acceleration=100.0),
}
"""By the role of a joint group. Source: reach of arms: UR, ±360°, and 0.1 rad for calibration; of hands: the
limits of ours end at 1.72 rad. The others are ours: the palm stays within 0.5 m of its start and 0.18 m above
the table. UR limits the torque only: 15 rad/s² of all joints at once take 51 N·m of the UR5e's 150. A fast
arm shakes the hand; fingers do not meet; 100 rad/s² take 0.22 of the Allegro hand's 0.5 N·m at most, which
is, as the arm's, several times what dry friction hides."""


def parts(workcell: WorkcellSpec) -> dict[str, tuple[str, ...]]:
    """The joints of what can be identified alone, by name: robots and hands, joint groups, and everything."""
    found = {}
    for placed in workcell.robots:
        for part in placed.robot.parts:
            name = part.name.removesuffix(f"_{part.tool.robot.name}") if part.tool else part.name
            joints = (joint for group in part.groups for joint in group.joints)
            found[placed.prefix + name] = tuple(placed.prefix + joint.name for joint in joints)
    found |= {group.name: tuple(joint.name for joint in group.joints) for group in workcell.groups}
    return found | {workcell.name: tuple(joint.name for joint in workcell.joints)}


def find_part(workcell: WorkcellSpec, name: str) -> tuple[str, ...]:
    """The joints of one of the `parts`, none if there is no such part.

    What follows behind an underscore may be left out where one part alone is meant.
    """
    known = parts(workcell)
    meant = [part for part in known if part.startswith(f"{name}_")]
    return known.get(name, known[meant[0]] if len(meant) == 1 else ())


def joints_of(workcell: WorkcellSpec, part: str | None) -> tuple[str, ...]:
    """The joints of one of the `parts`; none is everything.

    Raises:
        UnknownNameError: If there is no such part.
    """
    joints = find_part(workcell, part or workcell.name)
    if not joints:
        raise UnknownNameError("robot", str(part), parts(workcell))
    return joints


def specs_of(workcell: WorkcellSpec) -> dict[str, JointSpec]:
    """All joints by name, in joint order."""
    return {spec.name: spec for spec in workcell.joints}


def groups_of(workcell: WorkcellSpec) -> dict[str, JointGroup]:
    """The group of each joint, by the joint's name."""
    return {spec.name: group for group in workcell.groups for spec in group.joints}


def short(joint: str) -> str:
    """The name of a joint for people."""
    return joint.removesuffix("_joint").replace("_joint_", " ").replace("_", " ")


def largest_step(joint: JointSpec) -> float:
    """Largest change from a target to the next [rad]: at rest, it makes the servo move at its speed limit.

    A servo whose damping dominates moves at stiffness / damping times the distance of its target, see
    `envs/actuators.py`.
    """
    return SPEED_MARGIN * joint.velocity_limit * joint.damping / joint.stiffness


def recorded_model(workcell: WorkcellSpec, joints: Sequence[str], physics_dt: float) -> mujoco.MjModel:
    """The robots with only these joints, the others welded as in the start pose, at a time step [s].

    They have no object, contacts, limits, and none of MuJoCo's own dry friction.
    """
    spec = _without_object(workcell)
    for exclude in spec.excludes:
        spec.delete(exclude)
    whole = spec.compile()
    for name, joint in specs_of(workcell).items():
        if name not in joints:
            body, turned, turn = spec.joint(name).parent, np.zeros(4), np.zeros(4)
            mujoco.mju_axisAngle2Quat(turn, spec.joint(name).axis, joint.home)
            mujoco.mju_mulQuat(turned, whole.body(body.name).quat, turn)
            body.quat, body.alt.type = turned, mujoco.mjtOrientation.mjORIENTATION_QUAT
            spec.delete(spec.actuator(name))
            spec.delete(spec.joint(name))
    spec.compiler.fusestatic = True
    spec.option.timestep = physics_dt
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    model.dof_frictionloss[:] = 0.0
    model.actuator_ctrllimited[:] = 0
    model.actuator_forcelimited[:] = 0
    return model


def watched_model(workcell: WorkcellSpec, horizon: float) -> mujoco.MjModel:
    """Robots and table; what is within the horizon [m] counts as a contact without force."""
    model = _without_object(workcell).compile()
    model.geom_gap[:] = horizon / 2
    return model


def _without_object(workcell: WorkcellSpec) -> mujoco.MjSpec:
    spec = build_spec(SceneCfg(workcell=workcell.name))
    for sensor in spec.sensors:
        spec.delete(sensor)
    spec.delete(spec.body("object"))
    return spec


def hanging_on(parents: Int[np.ndarray, " num"]) -> Bool[np.ndarray, "num num"]:
    """Which elements (columns) of a tree hang on each (rows), itself included.

    Each has the number of its parent, which comes before it, as MuJoCo has bodies and degrees of freedom.
    """
    hangs = np.eye(len(parents), dtype=bool)
    for child, parent in enumerate(parents):
        if 0 <= parent < child:
            hangs[:, child] |= hangs[:, parent]
    return hangs
