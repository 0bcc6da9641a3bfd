"""Limits of the servo: motion of the joints, age of the inputs."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import partial
from math import pi
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.geometry import travel_columns
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.ros2.profile import MotionBudget, RobotPart
from pixel2catch.scene.constants import CONTROL_DT, SPEED_MARGIN
from pixel2catch.servo.laws import REST_ERROR, RETURN_TIME, STOP_TIME
from pixel2catch.servo.link import Joints
from pixel2catch.servo.workspace import Workspace

LOSS_TIME = 3.0  #: Age of the newest box after which the object is lost [s]. Source: ours; over a throw.
BEYOND_TRAVEL = 0.3  #: Possible motion of a joint beyond its travel [rad]. Source: ours, for soft fingers.
BRAKING_MARGIN = 0.01  #: Part of the stop time that braking leaves [s]. Source: ours; five ticks.
ROUNDING = 1e-6  #: Share of a driver's largest step that is kept for rounding.
TRAVEL_MARGIN = 0.05  #: Distance of an arm's commands from the ends of its travel [rad]. Source: ours.


def steady_lag(dynamics: JointDynamics) -> Joints:
    """Return the lag of each joint behind its command at a steady speed [s]."""
    return dynamics.latency + dynamics.filter_lookahead + dynamics.damping / dynamics.stiffness


def records(**columns: ArrayLike) -> np.ndarray:
    """Return a structured array with these columns as fields; scalars are repeated."""
    arrays = np.broadcast_arrays(*(np.atleast_1d(each) for each in columns.values()))
    types = [(name, array.dtype) for name, array in zip(columns, arrays, strict=True)]
    return np.array([*zip(*arrays, strict=True)], np.dtype(types, align=True))


def motion_columns(acceleration: Joints, jerk: Joints, dt: float) -> dict[str, Any]:
    """Return what the laws of motion derive from acceleration [rad/s²], jerk [rad/s³] and tick [s].

    `window` is the number of positions of which each joint's command is the mean, `share` the weight of one,
    `delay` the delay of the commands behind the positions [s]; `change` is the largest change of the speed in
    a tick [rad/s], `bend` that of the distance of a tick [rad].
    """
    ticks, change = 2.0 * acceleration / (jerk * dt), acceleration * dt
    window = np.maximum(np.ceil(ticks * (1.0 - 1e-12)), 1.0).astype(np.int64)
    share, delay = 1.0 / window, (window - 1) / 2.0 * dt
    return {"window": window, "share": share, "delay": delay, "change": change, "bend": change * dt, "dt": dt}


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLimits:
    """Limits of each joint, in joint order.

    Speed and acceleration are those of the commands. A joint follows its command through its servo, with the
    lag at a steady speed. The speed of the joint itself is therefore limited by `lead`.
    Sources: ours where none is given.
    """

    #: Lowest and highest command [rad]. Source: the spec. Where an arm joint turns by whole half turns, that
    #: is the end of its travel (UR), and `TRAVEL_MARGIN` is kept from it.
    lower: Joints
    upper: Joints
    #: Largest speed [rad/s] and acceleration [rad/s²] of a command, proportional to the share of the speed;
    #: lower for arms that are not identified (experiments/LOG.md). Braking must end within the stop time.
    speed: Joints
    acceleration: Joints
    #: Largest jerk of a command [rad/s³]. The acceleration of an arm may reverse in 10 ms, which delays
    #: commands by 4 ms; that of a finger in a tick, as the slowest hand takes every fifth.
    jerk: Joints
    #: Deceleration in a stop from full speed [rad/s²]; more where that takes too long. For an arm five
    #: times that of UR's driver after the last command: at full speed it stops in 0.13 s and 0.16 rad.
    deceleration: Joints
    step: Joints  #: Largest change in a tick [rad]. UR's control program ignores more than 0.04 rad in 2 ms.
    lag: Joints  #: Lag of a joint behind its command [s].
    #: Largest distance of a command ahead of its joint [rad]. As in training, a servo moves at 0.9 of the
    #: joint's speed limit at this distance.
    lead: Joints
    #: Distance of an arm joint from its expected position that is a fault [rad]. An arm that is held fast
    #: exceeds it; one whose positions have the largest allowed age does not. Objects may hold fingers.
    tracking_error: Joints
    lag_error: float  #: Allowed relative error of the lag; a joint that is not identified may have none.
    #: Distance of a finger joint from the explained position that is a fault [rad]: twice the distance
    #: by which objects push fingers in simulated catches.
    escape: Joints
    moved_error: Joints  #: Distance from a stopped command that means that somebody moved the joint [rad].
    least: Joints  #: Lowest position that a joint can have [rad].
    most: Joints  #: Highest position that a joint can have [rad].
    joint_speed: Joints  #: Speed of a joint that is a fault, with a margin for its estimate [rad/s].
    jump_speed: Joints  #: Speed that a joint cannot reach [rad/s].
    start_error: Joints  #: Largest distance of a joint from the first command [rad].
    #: Largest distance of the policy's first target from the first command [rad]. An action moves an arm's
    #: target by 0.48 rad at most; a finger's target may be anywhere.
    start_distance: Joints
    #: Age of a measured position that is a fault [s]: ten cycles of UR's driver, five of the slowest hand's.
    position_age: Joints
    period: Joints  #: Time for which the driver holds a command, and between two of its positions [s].

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
        """Return the limits of a work cell's robots at a share of the full speed, up to 1.

        The lag of joints is that of the dynamics, by default nominal; of joints that are not identified,
        commands are no faster than the joints. The `limits` of drivers may lower the full speed.
        """
        if not 0.0 < share <= 1.0:
            raise InvalidValueError(f"the share of the full speed is {share:g}; it must be in (0, 1]")
        each = partial(np.where, [group.role == "arm" for group in workcell.groups for _ in group.joints])
        lag = steady_lag(dynamics or JointDynamics.of(workcell.joints))
        most, full_speed = _allowed(workcell, parts), np.array([j.velocity_limit for j in workcell.joints])
        own_speed = share * np.minimum(full_speed, most["speed"])
        part = own_speed / full_speed
        arm_acceleration, arm_jerk = (1000.0, 200e3) if is_identified else (300.0, 60e3)
        allowed = np.minimum(most["acceleration"], [joint.acceleration_limit for joint in workcell.joints])
        acceleration = np.minimum(part * each(arm_acceleration, 2000.0), allowed)
        jerk = np.minimum(part * each(arm_jerk, 2e6), most["jerk"])
        stoppable = acceleration * (STOP_TIME - 2.0 * acceleration / jerk - BRAKING_MARGIN)
        fastest = np.minimum(most["command_speed"], stoppable)  # braking ends within the stop time
        even_speed = np.minimum(SPEED_MARGIN * own_speed, fastest)
        lead, age = even_speed * lag, each(0.02, 0.05)
        ends = np.array([(joint.lower, joint.upper) for joint in workcell.joints]).T
        half_turns = np.rint(ends / pi)
        are_of_travel = (half_turns != 0.0) & (np.abs(ends - half_turns * pi) <= 1e-6)
        margin = each(TRAVEL_MARGIN, 0.0) * are_of_travel
        return cls(
            lower=ends[0] + margin[0],
            upper=ends[1] - margin[1],
            speed=np.minimum(part * each(10.0, 20.0), fastest) if is_identified else even_speed,
            acceleration=acceleration,
            jerk=jerk,
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
            period=most["period"],
        )

    def __post_init__(self) -> None:
        if not (self.lower < self.upper).all():
            raise InvalidValueError("a joint's lower limit is not below its upper limit")
        for name in {entry.name for entry in fields(self)} - {"lower", "upper", "least", "most"}:
            if not np.all(getattr(self, name) > 0.0):
                raise InvalidValueError(f"{name} has entries that are not more than 0: {getattr(self, name)}")


def _allowed(workcell: WorkcellSpec, parts: Iterable[RobotPart]) -> dict[str, Joints]:
    """Return a laboratory's limits of each joint, by kind; infinite where there are none.

    The speed of commands is limited to what drivers accept, missed cycles included.
    """
    known = {joint: (part.limits, 1.0 / part.rate_hz) for part in parts for joint in part.joints}
    usual = MotionBudget(), ServoLimits.dt
    own, periods = zip(*(known.get(joint.name, usual) for joint in workcell.joints), strict=True)
    most = {kind.name: np.array([getattr(each, kind.name) for each in own]) for kind in fields(MotionBudget)}
    accepted = (1.0 - ROUNDING) * most["step"] / ((1.0 + most["missed_cycles"]) * ServoLimits.dt)
    accepted = np.minimum(most["command_speed"], accepted)
    return most | {"command_speed": accepted, "period": np.array(periods)}


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoLimits:
    """All limits of the servo. Source of the ages: ours, two to three periods of the sender."""

    joints: JointLimits
    workspace: Workspace
    dt: float = 0.002  #: Time between two commands [s]. Source: UR's control cycle.
    tick_age: float = 0.02  #: Time since the last tick that is a fault [s]; UR's driver halts after 40 ms.
    image_age: float = 0.1  #: Age of the newest image that is a fault [s].
    box_age: float = LOSS_TIME  #: Age of the newest box that is a fault [s].
    target_age: float = 2.0 * CONTROL_DT  #: Age of the newest targets that is a fault [s].
    #: Age of the operator's newest message that is a fault [s], and of a request to arm that still counts.
    #: Source: ours.
    operator_age: float = 0.2
    ramp_time: float = 1.0  #: Time in which commands go over to the policy's targets [s]. Source: ours.

    @classmethod
    def of(
        cls, workcell: WorkcellSpec, joints: JointLimits | None = None, parts: Iterable[RobotPart] = ()
    ) -> "ServoLimits":
        """Return the limits of a work cell, with nominal joint limits if none are given.

        A driver that takes commands more often than every `dt` gets one in each of its cycles.
        """
        joints, periods = joints or JointLimits.of(workcell), [1.0 / part.rate_hz for part in parts]
        return cls(joints=joints, workspace=Workspace(workcell=workcell), dt=min((cls.dt, *periods)))

    def __post_init__(self) -> None:
        motion = self.joint_records
        braking = motion["speed"] / motion["acceleration"] + motion["window"] * self.dt
        if (slowest := float(np.maximum(braking, motion["stop_time"]).max())) > STOP_TIME:
            raise InvalidValueError(
                f"a stop takes a joint up to {slowest:.3f} s; raise acceleration, jerk and deceleration or "
                f"lower the speed until it takes {STOP_TIME:.1f} s"
            )

    def joint_speed(self, ids: Int[np.ndarray, " some_joints"]) -> float:
        """Return the highest speed of some joints [rad/s], by their places in joint order."""
        return float(self.joint_records[ids]["even_speed"].max()) / SPEED_MARGIN

    def in_words(self, ids: Int[np.ndarray, " some_joints"]) -> str:
        """Describe the motion limits of some joints, by their places in joint order."""
        own = self.joint_records[ids]
        return (
            f"joints up to {self.joint_speed(ids):.3g} rad/s; "
            f"commands up to {own['speed'].max():.3g} rad/s, {own['acceleration'].max():.0f} rad/s², "
            f"{own['jerk'].max():.0f} rad/s³; a stop takes {own['stop_time'].max():.2f} s"
        )

    @property
    def num_joints(self) -> int:
        return len(self.joints.lower)

    @property
    def robot_records(self) -> np.ndarray:
        """Limits of the robot for the compiled laws, one entry."""
        numbers = {name: each for name, each in vars(self).items() if name not in ("joints", "workspace")}
        return records(**numbers)

    @property
    def joint_records(self) -> np.ndarray:
        """Limits of each joint for the compiled laws."""
        joints, even_speed = self.joints, self.joints.lead / self.joints.lag
        motion = motion_columns(joints.acceleration, joints.jerk, self.dt)
        is_arm = np.isfinite(joints.tracking_error)
        stop_time = joints.lead / (joints.lag * joints.deceleration)
        is_slow = SPEED_MARGIN * joints.speed <= (1.0 + ROUNDING) * even_speed  # as joints may be
        hold = (np.maximum(np.rint(joints.period / self.dt), 1.0) - 1.0) * self.dt
        sizes = [len(group.joints) for group in self.workspace.workcell.groups]
        group = np.repeat(np.arange(len(sizes)), sizes)[: self.num_joints]
        return records(
            **{**vars(joints), "speed": np.minimum(joints.speed, joints.step / self.dt)},
            **motion,
            **travel_columns(self.workspace.workcell.joints[: self.num_joints], joints.acceleration, self.dt),
            ramp_time=self.ramp_time,
            control_dt=CONTROL_DT,
            is_first=np.diff(group, prepend=-1) > 0,  # of its arm or hand
            is_last=np.diff(group, append=len(sizes)) > 0,
            is_arm=is_arm,  # it must stay near its expected position
            is_finger=np.isfinite(joints.escape),  # an object may hold it
            brake_time=is_slow * 0.5 * even_speed / joints.acceleration,  # for which they may lead more [s]
            stop_time=stop_time,  # in which a stop brings the joint to rest [s]
            even_speed=even_speed,  # at which the joint is not too fast, whatever its lag [rad/s]
            unseen_speed=np.where(is_arm, even_speed, np.inf),  # until the lag is estimated [rad/s]
            hold=hold,  # of a command beyond a tick [s]: a position may be as old, a command half as old
            time_ahead=self.dt + motion["delay"] + 0.5 * hold,  # that a tick looks ahead [s]
            stop_reach=joints.lead + 0.5 * even_speed * stop_time,  # limits the return of a stop [rad]
        )
