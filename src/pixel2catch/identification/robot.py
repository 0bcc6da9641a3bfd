"""All that this room knows of the robot: its joints by group, and models of it. Nothing else here imports it.

A group's commands arrive together, and excitation has one margin, swing and acceleration for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import mujoco
import numpy as np
from jaxtyping import Bool

from pixel2catch.robot.constants import ARM_JOINTS, FINGERS, HAND_JOINTS, JOINTS, SPEED_MARGIN, JointSpec
from pixel2catch.robot.scene import SceneCfg, build_spec


@dataclass(frozen=True, kw_only=True)
class JointGroup:
    """Joints that get their commands together."""

    joints: tuple[JointSpec, ...]  # in joint order
    # how the names of the joints of each serial chain begin; empty if the group is one chain, which
    # carries the other groups
    chains: tuple[str, ...] = ()
    # how the names of its bodies begin; empty if they are all bodies that are no other group's
    bodies: tuple[str, ...] = ()
    reach: float  # no joint gets so far from 0 [rad]
    margin: float  # distance that commands of an excitation keep from a joint's limits [rad]
    swing: float  # farthest from the middle of the excitation [rad]
    acceleration: float  # largest acceleration of its smooth commands [rad/s²]


ARM = JointGroup(joints=ARM_JOINTS, reach=2.0 * pi + 0.1, margin=0.03, swing=0.35, acceleration=15.0)
"""Source: reach: UR, ±360°, and 0.1 rad for calibration. The others are ours: the palm stays within 0.5 m of
its start and 0.18 m above the table. UR limits the torque only: 15 rad/s² of all joints at once take 51 N·m
of the UR5e's 150."""

HAND = JointGroup(
    joints=HAND_JOINTS,
    chains=FINGERS,
    bodies=("palm", *FINGERS),
    reach=pi,
    margin=0.06,
    swing=0.4,
    acceleration=100.0,
)
"""Source: reach: the limits in `robot.constants` end at 1.72 rad. The others are ours: a fast arm shakes the
hand; fingers do not meet; 100 rad/s² take 0.22 of the hand's 0.5 N·m at most. As the arm's, that is several
times what dry friction hides."""

GROUPS = (ARM, HAND)

JOINT_SPECS: dict[str, JointSpec] = {spec.name: spec for spec in JOINTS}
"""All joints that can be identified, by name, in joint order."""

GROUP_OF = {spec.name: group for group in GROUPS for spec in group.joints}  # the group of each joint

ROBOTS: dict[str, tuple[str, ...]] = {
    "ur5e": tuple(spec.name for spec in ARM_JOINTS),
    "allegro": tuple(spec.name for spec in HAND_JOINTS),
    "ur5e_allegro": tuple(JOINT_SPECS),
}
"""Joint names of each robot, in joint order."""

FILTERED_ROBOT = "ur5e"  # the robot whose controller filters commands
STANDING = ("base_link", "shoulder_link")  # bodies that stand on the table


def short(joint: str) -> str:
    """The name of a joint for people."""
    return joint.removesuffix("_joint").replace("_joint_", " ").replace("_", " ")


def largest_step(joint: JointSpec) -> float:
    """Largest change from a target to the next [rad]: at rest, it makes the servo move at its speed limit.

    A servo whose damping dominates moves at stiffness / damping times the distance of its target, see
    `envs/servo.py`.
    """
    return SPEED_MARGIN * joint.velocity_limit * joint.damping / joint.stiffness


def carries_others(joint: str) -> bool:
    """Whether a joint moves the joints of the other groups, too."""
    return not GROUP_OF[joint].chains


def groups_of(joints: Sequence[str]) -> Bool[np.ndarray, "num_groups num_joints"]:
    """Which of the joints are of each group, without groups that have none of them."""
    owned = np.array([[GROUP_OF[joint] is group for joint in joints] for group in GROUPS])
    return owned[owned.any(axis=1)]


def coupled(joints: Sequence[str]) -> Bool[np.ndarray, "num_joints num_joints"]:
    """Which joints (columns) the motion of each one moves: the rest of its chain, and what that carries."""
    chain = [
        next((c for c in GROUP_OF[joint].chains if joint.startswith(c)), "") for joint in joints
    ]  # of what carries the others: ""
    return np.array([[not one or one == other for other in chain] for one in chain])


def recorded_model(joints: Sequence[str], physics_dt: float) -> mujoco.MjModel:
    """The robot with only these joints, the others welded, at a time step [s].

    It has no object, contacts, limits, and none of MuJoCo's own dry friction.
    """
    spec = _without_object()
    for exclude in spec.excludes:
        spec.delete(exclude)
    for name in JOINT_SPECS:
        if name not in joints:
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


def watched_model(horizon: float) -> mujoco.MjModel:
    """Robot and table; what is within the horizon [m] counts as a contact without force."""
    model = _without_object().compile()
    model.geom_gap[:] = horizon / 2
    return model


def _without_object() -> mujoco.MjSpec:
    spec = build_spec(SceneCfg())
    for sensor in spec.sensors:
        spec.delete(sensor)
    spec.delete(spec.body("object"))
    return spec
