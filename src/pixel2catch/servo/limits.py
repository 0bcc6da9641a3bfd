"""What the servo keeps to: limits of the joints, and how old its inputs may be."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import partial
from math import isclose, pi

import numpy as np
from jaxtyping import Bool, Float64, Int, Int64
from numpy.typing import ArrayLike

from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.ros2.profile import MotionBudget, RobotPart
from pixel2catch.scene.constants import CONTROL_DT, SPEED_MARGIN
from pixel2catch.servo.workspace import Workspace

STOP_TIME = 0.3  #: Time after which the commands of a stop stand still [s]. Source: ours.
RETURN_TIME = 0.2  #: Part of it to go back to where the joints are [s]; the rest is to brake. Source: ours.
LOSS_TIME = 3.0
"""Time since the object was last seen after which it is lost [s]. Source: ours; longer than a throw lasts."""

BEYOND_TRAVEL = 0.3
"""Distance beyond the ends of its travel at which a joint cannot be [rad].

Source: ours; fingers give way, and encoders have offsets.
"""

REST_ERROR = 0.05
"""Distance of an arm's joint that stands still from its command that is none [rad]. Source: ours."""

Joints = Float64[np.ndarray, " joints"]

TRAVEL_MARGIN = 0.05  #: Distance of an arm's commands from the ends of its travel [rad]. Source: ours.


def steady_lag(dynamics: JointDynamics) -> Joints:
    """How far each joint is behind its command in a steady motion, per speed [s]."""
    return dynamics.latency + dynamics.filter_lookahead + dynamics.damping / dynamics.stiffness


def records(**columns: ArrayLike) -> np.ndarray:
    """Entries of a structured array whose fields are columns, or the same in all entries."""
    arrays = np.broadcast_arrays(*(np.atleast_1d(each) for each in columns.values()))
    types = [(name, array.dtype) for name, array in zip(columns, arrays, strict=True)]
    return np.array([*zip(*arrays, strict=True)], np.dtype(types, align=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionLimits:
    """What the motion of every joint's command keeps to."""

    lower: Joints  #: Lowest position [rad].
    upper: Joints  #: Highest position [rad].
    speed: Joints  #: Largest speed [rad/s].
    acceleration: Joints  #: Largest acceleration [rad/s²].
    jerk: Joints  #: Largest jerk [rad/s³].
    dt: float  #: Length of a tick [s].

    @property
    def window(self) -> Int64[np.ndarray, " joints"]:
        """How many positions a command of each joint is the mean of."""
        ticks = 2.0 * self.acceleration / (self.jerk * self.dt)
        return np.maximum(np.ceil(ticks * (1.0 - 1e-12)), 1.0).astype(np.int64)

    @property
    def delay(self) -> Joints:
        """How much later than the positions the commands are [s]."""
        return (self.window - 1) / 2.0 * self.dt

    @property
    def columns(self) -> dict[str, ArrayLike]:
        """What compiled laws ask of each joint's motion.

        Beside fields and properties: what a position counts in a command, the largest change of the speed in
        a tick [rad/s], and of the way of a tick from one to the next [rad].
        """
        change = self.acceleration * self.dt
        more = {"share": 1.0 / self.window, "change": change, "bend": change * self.dt, "delay": self.delay}
        return {**vars(self), "window": self.window, **more}


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLimits:
    """Limits of every joint, in joint order.

    Speed and acceleration are those of the commands, which run ahead of the joints: a joint follows through
    its servo, and at a steady speed it is `lag` behind. Its own speed is therefore limited by `lead`.

    Sources:
        lower, upper: those of the spec; where an arm's joint may go whole half turns, that is the end of
            its travel (UR), and `TRAVEL_MARGIN` is kept from it.
        speed, acceleration: ours, in proportion to the share of the speed; 300 rad/s² for an arm that is not
            identified. With 300 rad/s² for all, and a lag that was only as told, 94.2 % of 600 throws were
            caught in simulation; as it is, 97.0 of 400; without limits 97.0 of 600 (experiments/LOG.md).
        jerk: ours; an arm's acceleration may turn in 10 ms, for which commands come 4 ms later, a finger's
            in a tick: the slowest driver of a hand takes every fifth command.
        deceleration: ours; that of an arm is five times that with which UR's driver stops one that nobody
            commands any more, and lets it rest after 0.13 s and 0.16 rad from full speed. Joints that would
            not rest in time have more.
        step: ours; UR's control program ignores a step of an arm's joint above 0.04 rad in 2 ms.
        lead: as in training, the distance at which a servo moves at 0.9 of the joint's speed limit.
        joint_speed, jump_speed: ours; what a joint may do, or can, and what an estimate may be wrong by.
        tracking_error: ours; an arm that is held fast goes beyond it, one whose positions are as old as they
            may be does not. Fingers are held by what they hold.
        start_error, start_distance: ours; an arm's action moves the target by 0.48 rad at most, a
            finger's target is anywhere.
    """

    lower: Joints  #: Lowest command [rad].
    upper: Joints  #: Highest command [rad].
    speed: Joints  #: Largest speed of a command [rad/s].
    acceleration: Joints  #: Largest acceleration of a command [rad/s²].
    jerk: Joints  #: Largest jerk of a command [rad/s³].
    deceleration: Joints  #: Deceleration in a stop from the full speed [rad/s²].
    step: Joints  #: Largest change of a command in a tick [rad].
    lag: Joints  #: How long a joint is behind its command [s].
    lead: Joints  #: How far a command goes ahead of its joint [rad].
    tracking_error: Joints  #: Distance of a joint from where its servo should have it that is a fault [rad].
    #: How wrong the lag may be, as a share of it. Source: ours; a joint may follow at once if not identified.
    lag_error: float
    #: Distance of a finger's joint from what its commands explain that is a fault [rad]. Source: ours, twice
    #: what objects push fingers away in simulated catches.
    escape: Joints
    #: Distance from a stopped command from which somebody has moved the joint [rad]. Source: ours, three
    #: times `start_error`.
    moved_error: Joints
    least: Joints  #: Lowest position that a joint can have [rad].
    most: Joints  #: Highest position that a joint can have [rad].
    joint_speed: Joints  #: Speed of a joint that is a fault [rad/s].
    jump_speed: Joints  #: Speed that a joint cannot have [rad/s].
    start_error: Joints  #: Largest distance of a joint from the first command [rad].
    start_distance: Joints  #: Largest distance of the policy's first target from the first command [rad].
    #: Age of a measured position that is a fault [s]. Source: ours, ten cycles of the UR driver, five of the
    #: slowest Allegro driver.
    position_age: Joints

    @classmethod
    def of(
        cls,
        workcell: WorkcellSpec,
        share: float = 1.0,
        dynamics: JointDynamics | None = None,
        *,
        is_identified: bool = True,
        parts: Iterable[RobotPart] = (),
    ) -> "JointLimits":
        """The limits of the robots of a work cell, at a share of the full speed, more than 0 and up to 1.

        The full speed is that of the spec, or what a laboratory allows the joint's part, if that is less.

        Joints of one role have the same limits where the spec does not say more. The lag is that of the
        dynamics of all joints, nominal if absent. Where it has not been identified, commands are no faster
        than joints may be: a joint with a shorter lag than told would otherwise be faster than it may.

        Raises:
            InvalidValueError: The share is out of range.
        """
        if not 0.0 < share <= 1.0:
            raise InvalidValueError(f"the share of the full speed is {share:g}; it must be in (0, 1]")
        each = partial(_by_role, workcell)
        lag = steady_lag(dynamics or JointDynamics.nominal(specs=workcell.joints))
        full_speed = np.array([joint.velocity_limit for joint in workcell.joints])
        most = _allowed(workcell, parts)
        own_speed = share * np.minimum(full_speed, most["speed"])
        even_speed = SPEED_MARGIN * own_speed
        part = own_speed / full_speed
        acceleration = np.minimum(
            part * each(1000.0 if is_identified else 300.0, 2000.0), most["acceleration"]
        )
        lead, age = even_speed * lag, each(0.02, 0.05)
        ends = np.array([(joint.lower, joint.upper) for joint in workcell.joints]).T
        margin = each(TRAVEL_MARGIN, 0.0) * np.vectorize(_is_end_of_travel)(ends)
        return cls(
            lower=ends[0] + margin[0],
            upper=ends[1] - margin[1],
            speed=part * each(10.0, 20.0) if is_identified else even_speed,
            acceleration=acceleration,
            jerk=np.minimum(part * each(200e3 if is_identified else 60e3, 2e6), most["jerk"]),
            deceleration=np.minimum(np.maximum(each(20.0, 100.0), even_speed / RETURN_TIME), acceleration),
            step=each(0.03, 0.04),
            lag=lag,
            lead=lead,
            tracking_error=np.maximum(0.75 * lead, REST_ERROR + own_speed * age) * each(1.0, np.inf),
            lag_error=0.75 if is_identified else 1.0,
            escape=each(np.inf, 0.5),
            moved_error=each(0.06, np.inf),
            least=ends[0] - BEYOND_TRAVEL,
            most=ends[1] + BEYOND_TRAVEL,
            joint_speed=own_speed + each(0.15, np.inf) * full_speed,
            jump_speed=1.2 * full_speed,
            start_error=each(0.02, 0.2),
            start_distance=each(0.5, np.inf),
            position_age=age,
        )

    @property
    def is_arm(self) -> Bool[np.ndarray, " joints"]:
        """Which joints are watched as an arm's, which their servo keeps near their command."""
        return np.isfinite(self.tracking_error)

    @property
    def is_finger(self) -> Bool[np.ndarray, " joints"]:
        """Which joints are watched as fingers, which an object may stop."""
        return np.isfinite(self.escape)

    @property
    def stop_time(self) -> Joints:
        """Time in which a stop takes each joint to rest [s]."""
        return self.lead / (self.lag * self.deceleration)

    def __post_init__(self) -> None:
        """Refuse limits that are none."""
        if not (self.lower < self.upper).all():
            raise InvalidValueError("a joint's lower limit is not below its upper limit")
        for name in {entry.name for entry in fields(self)} - {"lower", "upper", "least", "most"}:
            if not np.all(getattr(self, name) > 0.0):
                raise InvalidValueError(f"{name} has entries that are not more than 0: {getattr(self, name)}")


def _by_role(workcell: WorkcellSpec, arm: float, hand: float) -> Joints:
    """One number for the joints of arms, and one for those of hands."""
    return np.array([arm if group.role == "arm" else hand for group in workcell.groups for _ in group.joints])


def _allowed(workcell: WorkcellSpec, parts: Iterable[RobotPart]) -> dict[str, Joints]:
    """What a laboratory allows each joint, by the kind of limit; infinite where it says nothing."""
    budgets = {joint: part.limits for part in parts for joint in part.joints}
    of_joints = [budgets.get(joint.name, MotionBudget()) for joint in workcell.joints]
    return {
        entry.name: np.array([getattr(budget, entry.name) for budget in of_joints])
        for entry in fields(MotionBudget)
    }


def _is_end_of_travel(limit: float) -> bool:
    """Whether a limit [rad] is a whole number of half turns, and not one of the task."""
    half_turns = round(limit / pi)
    return half_turns != 0 and isclose(limit, half_turns * pi, abs_tol=1e-6)


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoLimits:
    """All that the servo keeps to. Source of the ages: ours, two to three periods of what sends."""

    joints: JointLimits
    workspace: Workspace
    #: Time between two commands [s]. Source: UR's control cycle.
    dt: float = 0.002
    #: Time since the last tick that is a fault [s]; UR's driver halts after 40 ms of silence.
    tick_age: float = 0.02
    #: Age of the newest image that is a fault [s].
    image_age: float = 0.1
    #: Age of the newest box of the object that is a fault [s]; before, the control loop holds the arm.
    box_age: float = LOSS_TIME
    #: Age of the newest targets that is a fault [s].
    target_age: float = 2.0 * CONTROL_DT
    #: Time since the operator last held the dead-man switch that is a fault [s], and up to which a request
    #: to arm is heeded. Source: ours.
    operator_age: float = 0.2
    #: Time over which the policy takes over from the pose at the start [s]. Source: ours.
    ramp_time: float = 1.0

    @classmethod
    def of(cls, workcell: WorkcellSpec, joints: JointLimits | None = None) -> "ServoLimits":
        """Those of a work cell, and of its joints if there are no others."""
        return cls(joints=joints or JointLimits.of(workcell), workspace=Workspace(workcell=workcell))

    def __post_init__(self) -> None:
        """Refuse limits under which a stop takes too long."""
        motion = self.motion
        braking = float(np.max(motion.speed / motion.acceleration + motion.window * self.dt))
        if braking > STOP_TIME - RETURN_TIME:
            raise InvalidValueError(
                f"braking takes up to {braking:.3f} s; raise acceleration and jerk or lower the speed until "
                f"it takes {STOP_TIME - RETURN_TIME:.1f} s"
            )
        if (slowest := float(np.max(self.joints.stop_time))) > RETURN_TIME + self.dt:
            raise InvalidValueError(
                f"a stop takes a joint up to {slowest:.3f} s; raise the deceleration or lower the speed "
                f"until it takes {RETURN_TIME:.1f} s"
            )

    def in_words(self, ids: Int[np.ndarray, " some_joints"]) -> str:
        """What the motion of some joints, by their places in joint order, keeps to."""
        motion, joints = self.motion, self.joints
        own_speed = (joints.lead / (joints.lag * SPEED_MARGIN))[ids].max()
        return (
            f"joints up to {own_speed:.3g} rad/s; commands up to {motion.speed[ids].max():.3g} rad/s, "
            f"{motion.acceleration[ids].max():.0f} rad/s², {motion.jerk[ids].max():.0f} rad/s³; "
            f"a stop takes {joints.stop_time[ids].max():.2f} s"
        )

    @property
    def num_joints(self) -> int:
        """How many joints the robots have."""
        return len(self.joints.lower)

    @property
    def motion(self) -> MotionLimits:
        """Limits of the commands' motion."""
        joints = self.joints
        return MotionLimits(
            lower=joints.lower,
            upper=joints.upper,
            speed=np.minimum(joints.speed, joints.step / self.dt),
            acceleration=joints.acceleration,
            jerk=joints.jerk,
            dt=self.dt,
        )

    @property
    def robot_records(self) -> np.ndarray:
        """The numbers of a robot, for compiled laws: one entry."""
        numbers = {name: each for name, each in vars(self).items() if name not in ("joints", "workspace")}
        return records(**numbers)

    @property
    def joint_records(self) -> np.ndarray:
        """The limits of each joint, for compiled laws.

        Beside fields and properties: speed of commands at which no joint is too fast, whatever its lag, which
        an arm's keep to until that is seen [rad/s]; how far ahead in time a tick aims [s]; how far a stop may
        lead back [rad].
        """
        joints, motion = self.joints, self.motion
        even_speed = joints.lead / joints.lag
        return records(
            **{**vars(joints), **motion.columns},
            ramp_time=self.ramp_time,
            control_dt=CONTROL_DT,
            is_arm=joints.is_arm,
            is_finger=joints.is_finger,
            stop_time=joints.stop_time,
            even_speed=even_speed,
            unseen_speed=np.where(joints.is_arm, even_speed, np.inf),
            time_ahead=self.dt + motion.delay,
            stop_reach=joints.lead + 0.5 * even_speed * joints.stop_time,
        )
