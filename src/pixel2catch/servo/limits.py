"""What the servo keeps to: limits of the joints, and how old its inputs may be."""

from dataclasses import dataclass, field, fields
from math import pi

import numpy as np

from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.constants import ARM_JOINTS, CONTROL_DT, HAND_JOINTS, JOINTS, SPEED_MARGIN
from pixel2catch.servo.motion import Joints, MotionLimits
from pixel2catch.servo.workspace import Workspace

STOP_TIME = 0.3
"""Time after which the commands of a stop stand still [s]. Source: ours."""

RETURN_TIME = 0.2
"""Part of it in which they go back to where the joints are [s]; the rest is for braking. Source: ours."""

TRAVEL_MARGIN = 0.05
"""Distance that commands of the arm keep from the ends of its joints' travel [rad]. Source: ours."""


def _arm_and_hand(arm: float, hand: float) -> Joints:
    return np.array([arm] * len(ARM_JOINTS) + [hand] * len(HAND_JOINTS))


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLimits:
    """Limits of every joint, in joint order.

    Speed and acceleration are those of the commands, which run ahead of the joints: a joint follows through
    its servo, and at a steady speed it is `lag` behind. Its own speed is therefore limited by `lead`.

    Attributes:
        lower: Lowest command [rad].
        upper: Highest command [rad].
        speed: Largest speed of a command [rad/s].
        acceleration: Largest acceleration of a command [rad/s²].
        step: Largest change of a command in a tick [rad].
        lag: How long a joint is behind its command [s].
        lead: How far a command goes ahead of its joint [rad].
        tracking_error: Distance of a joint from where its servo should have it that is a fault [rad].
        moved_error: Distance of a joint from a stopped command from which somebody else has moved it [rad].
        start_error: Largest distance of a joint from the first command [rad].
        start_distance: Largest distance of the policy's first target from the first command [rad].
        position_age: Age of a measured position that is a fault [s].
    """

    lower: Joints
    upper: Joints
    speed: Joints
    acceleration: Joints
    step: Joints
    lag: Joints
    lead: Joints
    tracking_error: Joints
    moved_error: Joints
    start_error: Joints
    start_distance: Joints
    position_age: Joints

    @classmethod
    def of(cls, dynamics: JointDynamics, share: float = 1.0) -> "JointLimits":
        """The limits of the robot.

        Args:
            dynamics: Of all joints, for their lag.
            share: Share of the full speed, more than 0 and up to 1.

        Sources:
            lower, upper: those of training, and UR's ends of travel less `TRAVEL_MARGIN`.
            speed, acceleration: ours. In simulation the whole servo costs the shipped policies no success: of
                100 throws `proposed`, `single_agent` and `only_center` catch 91, 93 and 96, without it 93, 92
                and 94. A command stops in 36 ms. With 4 rad/s and 100 rad/s² `proposed` loses 8.
            step: ours; UR's control program ignores a step of an arm's joint above 0.04 rad in 2 ms.
            lead: as in training, the distance at which a servo moves at 0.9 of the joint's speed limit.
            tracking_error: ours; an arm that is held fast goes beyond it. Fingers are held by what they hold.
            moved_error: ours; three times `start_error`.
            start_error, start_distance: ours; an arm's action moves the target by 0.48 rad at most, a
                finger's target is anywhere.
            position_age: ours: ten cycles of the UR driver, five of the slowest Allegro driver.

        Raises:
            InvalidValueError: The share is out of range.
        """
        if not 0.0 < share <= 1.0:
            raise InvalidValueError(f"the share of the full speed is {share:g}; it must be in (0, 1]")
        lag = dynamics.latency + dynamics.filter_lookahead + dynamics.damping / dynamics.stiffness
        lead = share * SPEED_MARGIN * np.array([joint.velocity_limit for joint in JOINTS]) * lag
        travel = _arm_and_hand(2 * pi - TRAVEL_MARGIN, np.inf)
        travel[ELBOW] -= pi
        return cls(
            lower=np.maximum([joint.lower for joint in JOINTS], -travel),
            upper=np.minimum([joint.upper for joint in JOINTS], travel),
            speed=share * _arm_and_hand(10.0, 20.0),
            acceleration=_arm_and_hand(300.0, 2000.0),
            step=_arm_and_hand(0.03, 0.04),
            lag=lag,
            lead=lead,
            tracking_error=0.75 * lead * _arm_and_hand(1.0, np.inf),
            moved_error=_arm_and_hand(0.06, np.inf),
            start_error=_arm_and_hand(0.02, 0.2),
            start_distance=_arm_and_hand(0.5, np.inf),
            position_age=_arm_and_hand(0.02, 0.05),
        )

    def __post_init__(self) -> None:
        """Refuse limits that are none."""
        if not (self.lower < self.upper).all():
            raise InvalidValueError("a joint's lower limit is not below its upper limit")
        for name in {entry.name for entry in fields(self)} - {"lower", "upper"}:
            if not (getattr(self, name) > 0.0).all():
                raise InvalidValueError(f"{name} has entries that are not more than 0: {getattr(self, name)}")


ELBOW = 2
"""Column of the elbow, which turns by half of what the other joints of the arm do. Source: UR."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoLimits:
    """All that the servo keeps to. The ages are ours: two to three periods of what sends, if nothing is said.

    Attributes:
        joints: Limits of the joints.
        workspace: Where the robot may be.
        dt: Time between two commands [s]. Source: UR's control cycle.
        tick_age: Time since the last tick that is a fault [s]; UR's driver halts after 40 ms of silence.
        image_age: Age of the newest image that is a fault [s].
        target_age: Age of the newest targets that is a fault [s].
        operator_age: Time since the operator last held the dead-man switch that is a fault [s], and up to
            which a request to arm is heeded. Source: ours.
        ramp_time: Time over which the policy takes over from the pose at the start [s]. Source: ours.
    """

    joints: JointLimits = field(default_factory=lambda: JointLimits.of(JointDynamics.nominal()))
    workspace: Workspace = field(default_factory=Workspace)
    dt: float = 0.002
    tick_age: float = 0.02
    image_age: float = 0.1
    target_age: float = 2.0 * CONTROL_DT
    operator_age: float = 0.2
    ramp_time: float = 1.0

    def __post_init__(self) -> None:
        """Refuse limits under which a stop takes too long."""
        slowest = float(np.max(self.motion.speed / self.motion.acceleration)) + self.dt
        if slowest > STOP_TIME - RETURN_TIME:
            raise InvalidValueError(
                f"braking takes up to {slowest:.3f} s; raise the acceleration or lower the speed until it "
                f"takes {STOP_TIME - RETURN_TIME:.1f} s"
            )

    @property
    def motion(self) -> MotionLimits:
        """Limits of the commands' motion."""
        joints = self.joints
        return MotionLimits(
            lower=joints.lower,
            upper=joints.upper,
            speed=np.minimum(joints.speed, joints.step / self.dt),
            acceleration=joints.acceleration,
            dt=self.dt,
        )
