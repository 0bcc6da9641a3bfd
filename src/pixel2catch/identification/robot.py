"""All that this room needs to know of a robot, as a value that recordings and trajectories carry.

Only `ROBOT`, the default, names one. A group's commands arrive together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi

import mujoco
import numpy as np
from jaxtyping import Bool

from pixel2catch.scene.constants import ARM_JOINTS, HAND_JOINTS, SPEED_MARGIN, JointSpec
from pixel2catch.scene.scene import SceneCfg, build_spec


@dataclass(frozen=True, kw_only=True)
class JointGroup:
    """Joints that get their commands together."""

    name: str  # what commands and files call it
    joints: tuple[JointSpec, ...]
    # how the names of the joints of each serial chain begin; none if it is one chain that carries the others
    chains: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()  # how the names of its bodies begin; none if they are what is left
    is_ur: bool = False  # whether its controller filters commands by servoJ, and logs motion by RTDE
    reach: float  # no joint gets so far from 0 [rad]
    margin: float  # distance that commands of an excitation keep from a joint's limits [rad]
    swing: float  # farthest from the middle of the excitation [rad]
    acceleration: float  # largest acceleration of its smooth commands [rad/s²]


@dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """Groups of joints in joint order, and the scene in which they move."""

    groups: tuple[JointGroup, ...]
    whole: str  # what commands call all groups together
    standing: tuple[str, ...]  # bodies that stand on the table
    scene: Callable[[], mujoco.MjSpec]  # the robot, a body `table` and a body `object`

    @cached_property
    def specs(self) -> dict[str, JointSpec]:
        """All joints by name, in joint order."""
        return {spec.name: spec for group in self.groups for spec in group.joints}

    @cached_property
    def group_of(self) -> dict[str, JointGroup]:
        """The group of each joint."""
        return {spec.name: group for group in self.groups for spec in group.joints}

    @cached_property
    def parts(self) -> dict[str, tuple[str, ...]]:
        """What can be identified alone: the joints of each group, and all of them, by name."""
        groups = {group.name: tuple(spec.name for spec in group.joints) for group in self.groups}
        return groups | {self.whole: tuple(self.specs)}

    @property
    def ur_part(self) -> str:
        """The part whose controller is Universal Robots'; empty if there is none."""
        return next((group.name for group in self.groups if group.is_ur), "")

    def owned(self, joints: Sequence[str]) -> Bool[np.ndarray, "num_groups num_joints"]:
        """Which of the joints are of each group, without groups that have none of them."""
        owned = np.array([[self.group_of[joint] is group for joint in joints] for group in self.groups])
        return owned[owned.any(axis=1)]

    def carries_others(self, joint: str) -> bool:
        """Whether a joint moves the joints of the other groups, too."""
        return not self.group_of[joint].chains

    def coupled(self, joints: Sequence[str]) -> Bool[np.ndarray, "num_joints num_joints"]:
        """Which joints (columns) each one moves: the rest of its chain, and what that carries."""
        chains = [next((c for c in self.group_of[j].chains if j.startswith(c)), "") for j in joints]
        return np.array([[one in ("", other) for other in chains] for one in chains])

    def recorded_model(self, joints: Sequence[str], physics_dt: float) -> mujoco.MjModel:
        """The robot with only these joints, the others welded, at a time step [s].

        It has no object, contacts, limits, and none of MuJoCo's own dry friction.
        """
        spec = self._without_object()
        for exclude in spec.excludes:
            spec.delete(exclude)
        for name in self.specs:
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

    def watched_model(self, horizon: float) -> mujoco.MjModel:
        """Robot and table; what is within the horizon [m] counts as a contact without force."""
        model = self._without_object().compile()
        model.geom_gap[:] = horizon / 2
        return model

    def _without_object(self) -> mujoco.MjSpec:
        spec = self.scene()
        for sensor in spec.sensors:
            spec.delete(sensor)
        spec.delete(spec.body("object"))
        return spec


def short(joint: str) -> str:
    """The name of a joint for people."""
    return joint.removesuffix("_joint").replace("_joint_", " ").replace("_", " ")


def largest_step(joint: JointSpec) -> float:
    """Largest change from a target to the next [rad]: at rest, it makes the servo move at its speed limit.

    A servo whose damping dominates moves at stiffness / damping times the distance of its target, see
    `envs/servo.py`.
    """
    return SPEED_MARGIN * joint.velocity_limit * joint.damping / joint.stiffness


FINGERS = ("index", "middle", "ring", "thumb")

ARM = JointGroup(
    name="ur5e",
    joints=ARM_JOINTS,
    is_ur=True,
    reach=2.0 * pi + 0.1,
    margin=0.03,
    swing=0.35,
    acceleration=15.0,
)
"""Source: reach: UR, ±360°, and 0.1 rad for calibration. The others are ours: the palm stays within 0.5 m of
its start and 0.18 m above the table. UR limits the torque only: 15 rad/s² of all joints at once take 51 N·m
of the UR5e's 150."""

HAND = JointGroup(
    name="allegro",
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

ROBOT = Robot(
    groups=(ARM, HAND),
    whole="ur5e_allegro",
    standing=("base_link", "shoulder_link"),
    scene=lambda: build_spec(SceneCfg()),
)

JOINT_SPECS, ROBOTS = ROBOT.specs, ROBOT.parts
