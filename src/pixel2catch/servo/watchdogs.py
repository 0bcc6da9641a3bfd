"""What the servo is told in a tick, and what is wrong with it.

All stamps are of one monotonic clock. A stamp that is no number, or of the future, is as bad as an old one.
"""

from dataclasses import dataclass
from enum import IntFlag, auto
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float64, Int64

from pixel2catch.servo.limits import REST_ERROR, ServoLimits
from pixel2catch.servo.motion import Bits, Flags, Rows, Times

JITTER = 0.015  #: How much earlier or later a position may arrive than others do [s]. Source: ours.
SMOOTHING = 0.04  #: Time over which the speed of a joint is estimated [s]. Source: ours.
SLACK_LAGS = 3.0
"""In how many lags a distance from the command is forgotten that a motion explains. Source: ours."""

FROZEN_ANGLE = 0.01
"""Motion of a command in which its joint must be measured elsewhere by a bit at least [rad]. Source: ours."""

FROZEN_TIME = 0.15  #: Time that a joint has for that [s]. Source: ours, more than the lag of any servo here.
LAG_MARGIN = 1.05
"""Share of the lag that is seen that counts. Source: ours, half of what the speed has to spare."""

LEAST_LAG = 0.002  #: Lag that any joint has [s]. Source: ours, a tick.

LEAST_EVIDENCE, MOST_EVIDENCE = 0.003, 0.15
"""Motion from which the lag of a joint is known, and that of which it is the mean: v² t [rad²/s].

Source: ours; 0.03 s after the beginning of a swing, and 0.02 s of the fastest.
"""

CLOCK_ERROR = 1e-3  #: How far ahead a stamp may be [s]. Source: ours; processes read the clock in turn.


class Fault(IntFlag):
    """What stops the robot, or keeps it from being armed; recordings have the numbers: append."""

    CLOCK = auto()
    JOINTS_STALE = auto()
    JOINTS_NOT_FINITE = auto()
    IMAGE_STALE = auto()
    POLICY_LATE = auto()
    TARGET_NOT_FINITE = auto()
    TARGET_FAR = auto()
    TRACKING_ERROR = auto()
    SAFETY_MODE = auto()
    SPEED_SCALING = auto()
    OTHER_PUBLISHER = auto()
    DEAD_MAN = auto()
    STOP_REQUEST = auto()
    START_POSE = auto()
    WORKSPACE = auto()
    STILL_STOPPING = auto()
    JOINTS_IMPLAUSIBLE = auto()
    JOINT_SPEED = auto()
    OTHER_OPERATOR = auto()
    SWITCH_NOT_PRESSED = auto()
    OBJECT_LOST = auto()
    PERCEPTION_UNSOUND = auto()
    STATUS_UNKNOWN = auto()
    NO_SUBSCRIBER = auto()
    OTHER_SUBSCRIBER = auto()
    CONTROLLER = auto()
    JOINTS_FROZEN = auto()


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoInputs:
    """What the servo is told in a tick, one row per robot, joints in joint order."""

    now: Times  #: Time of this tick [s].
    joint_pos: Rows  #: Newest measured joint positions [rad].
    joint_stamp: Rows  #: When each was measured [s].
    joint_pos_target: Rows  #: Newest targets of the policy [rad].
    target_stamp: Times  #: When they were decided [s].
    image_stamp: Times  #: When the newest image was taken [s].
    box_stamp: Times  #: When the newest image was taken in which the object was seen [s].
    is_perception_sound: Flags  #: Whether what perception says can be true.
    dead_man_stamp: Times  #: When the operator last held the dead-man switch [s].
    #: When the switch was last pressed after it had been let go, or silent for too long [s].
    pressed_stamp: Times
    arm_stamp: Times  #: When the operator last asked to arm [s].
    is_stop_requested: Flags  #: Whether the operator, or anything else, asks to stop.
    is_safe: Flags  #: Whether the robot's program runs in its normal safety mode.
    speed_scaling: Times  #: Share of the full speed at which the robot runs its program; 1 is full.
    is_status_known: Flags  #: Whether the drivers have said all that is watched of them, and it holds.
    has_controller: Flags  #: Whether the controllers that take our commands are active.
    has_other_publisher: Flags  #: Whether anybody else sends commands to the robot.
    has_other_operator: Flags  #: Whether several hold the switch, or ask to arm.
    has_subscriber: Flags  #: Whether somebody takes the commands of each driver.
    has_other_subscriber: Flags  #: Whether several take the commands of one.

    @cached_property
    def is_measured(self) -> Bool[np.ndarray, "rows joints"]:
        """Which joint positions are numbers."""
        return np.isfinite(self.joint_pos)


@dataclass(frozen=True, kw_only=True, eq=False)
class Commanded:
    """What the joints have been told up to a tick."""

    position: Rows  #: Newest commands [rad].
    expected: Rows  #: Where the joints should be, by the lag of their servos [rad].
    is_followed: Flags  #: Whether the robot has been commanded, from the same pose on, for a tick at least.


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTrack:
    """What has been measured of every joint so far, and what of it the commands explain."""

    position: Rows  #: Newest position that was a number [rad].
    stamp: Rows  #: When it was measured [s].
    speed: Rows  #: Estimated speed [rad/s].
    explained: Rows  #: Position nearest to it to which the commands may have led, or something stopped [rad].
    slack: Rows  #: How far behind its command a joint may still be, by the motion of late [rad].
    anchor: Rows  #: Where the command was when the measurement last changed [rad].
    still_time: Rows  #: How long the measurement has not changed, though the command has moved [s].
    ahead: Rows  #: How far the command is ahead of the joint [rad], in the mean of the time of its speed.
    seen_lag: Rows  #: How much that is for its speed, by its motion of late [s].
    evidence: Rows  #: How much motion that is known of [rad²/s].
    #: Which joints of an arm have moved enough for their lag to be known by that.
    is_lag_seen: Bool[np.ndarray, "rows joints"]
    lag: Rows  #: How long joints are behind their commands [s]: as told, or as seen as soon as it is.

    @classmethod
    def unknown(cls, num_rows: int, num_joints: int) -> "JointTrack":
        """Before the first measurement."""
        none = np.full((num_rows, num_joints), np.nan)
        zeros = np.zeros((num_rows, num_joints))
        return cls(
            position=none,
            stamp=none,
            speed=zeros,
            explained=zeros,
            slack=zeros,
            anchor=zeros,
            still_time=zeros,
            ahead=zeros,
            seen_lag=zeros,
            evidence=zeros,
            is_lag_seen=zeros > 0.0,
            lag=zeros,
        )

    def expected(self, before: Rows, command: Rows, limits: ServoLimits) -> Rows:
        """Where the joints are a tick later by their lag, from where they should have been before [rad]."""
        return before + np.minimum(limits.dt / self.lag, 1.0) * (command - before)

    def continued(
        self, inputs: ServoInputs, commanded: Commanded, limits: ServoLimits
    ) -> tuple["JointTrack", Bool[np.ndarray, "rows joints"]]:
        """What is known with new positions, and which of them went as none can."""
        joints, position, stamp = limits.joints, inputs.joint_pos, inputs.joint_stamp
        is_measured = inputs.is_measured
        is_new = is_measured & np.isfinite(stamp) & ~(stamp <= self.stamp)
        is_next = is_new & np.isfinite(self.stamp)
        elapsed = np.where(is_next, stamp - self.stamp, 0.0)
        moved = np.where(is_next, position - self.position, 0.0)
        is_jump = np.abs(moved) > joints.jump_speed * (elapsed + JITTER)
        share = np.minimum(elapsed / SMOOTHING, 1.0)
        speed = (1.0 - share) * self.speed + np.where(is_jump, 0.0, moved / np.maximum(elapsed, SMOOTHING))
        command, expected = commanded.position, commanded.expected
        is_followed = commanded.is_followed[:, None]
        nearest = np.minimum(np.minimum(command, expected), self.explained)
        nearest = np.maximum(
            nearest, np.minimum(position, np.maximum(np.maximum(command, expected), self.explained))
        )
        explained = np.where(is_followed, nearest, position)
        anchor = np.where(is_followed & (moved == 0.0), self.anchor, command)
        is_still = np.abs(command - anchor) > FROZEN_ANGLE
        # A joint that follows with a lag has the speed (command - position) / lag, whatever the command does;
        # so has every mean of both.
        ahead = (1.0 - share) * self.ahead + np.where(is_next, command - self.position, 0.0) * share
        ahead = np.where(is_followed, ahead, 0.0)
        way = np.where(is_followed, speed * elapsed, 0.0)
        evidence = np.minimum(self.evidence + way * speed, MOST_EVIDENCE)
        seen_lag = self.seen_lag + way * (ahead - self.seen_lag * speed) / np.maximum(evidence, 1e-9)
        is_lag_seen = joints.is_arm & (evidence >= LEAST_EVIDENCE)
        # Up to the lag that is told, a little more than is seen counts; beyond it, what is seen.
        most_lag = np.minimum(np.maximum(joints.lag, seen_lag), (1.0 + joints.lag_error) * joints.lag)
        own_lag = np.minimum(np.maximum(LAG_MARGIN * seen_lag, LEAST_LAG), most_lag)
        track = JointTrack(
            position=np.where(is_new, position, self.position),
            stamp=np.where(is_new, stamp, self.stamp),
            speed=speed,
            explained=np.where(is_measured, explained, self.explained),
            slack=np.maximum(
                np.abs(command - expected), self.slack * (1.0 - limits.dt / (SLACK_LAGS * joints.lag))
            ),
            anchor=anchor,
            still_time=np.where(is_still, self.still_time + limits.dt, 0.0),
            ahead=ahead,
            seen_lag=seen_lag,
            evidence=evidence,
            is_lag_seen=is_lag_seen,
            lag=np.where(is_lag_seen, own_lag, joints.lag),
        )
        return track, is_jump


def is_recent(
    now: Float64[np.ndarray, "*#rows"], stamp: Float64[np.ndarray, "*rows"], age: float | np.ndarray
) -> Bool[np.ndarray, "*rows"]:
    """Whether stamps are of the time up to an age ago [s]."""
    elapsed = now - stamp
    return (elapsed >= -CLOCK_ERROR) & (elapsed <= age)


@lru_cache
def _values(names: tuple[str, ...]) -> Int64[np.ndarray, " names"]:
    return np.array([Fault[name] for name in names], dtype=np.int64)


def bits(**flags: Flags) -> Bits:
    """The faults that hold in each row, by their names, as one number."""
    return _values(tuple(flags)) @ np.array([*flags.values()])


def faults_of_robot(inputs: ServoInputs, limits: ServoLimits, last_tick: Times) -> Bits:
    """What is wrong with robot, operator and clock, by the inputs and the time of the tick before [s]."""
    now = inputs.now
    elapsed = now - last_tick
    is_joint_measured = is_recent(now[:, None], inputs.joint_stamp, limits.joints.position_age)
    is_measured = np.logical_and.reduce(is_joint_measured, axis=-1)
    return bits(
        CLOCK=~((elapsed > 0.0) & (elapsed <= limits.tick_age)),
        JOINTS_STALE=~is_measured,
        JOINTS_NOT_FINITE=~np.logical_and.reduce(inputs.is_measured, axis=-1),
        SAFETY_MODE=~inputs.is_safe,
        SPEED_SCALING=inputs.speed_scaling != 1.0,
        STATUS_UNKNOWN=~inputs.is_status_known,
        CONTROLLER=~inputs.has_controller,
        NO_SUBSCRIBER=~inputs.has_subscriber,
        OTHER_SUBSCRIBER=inputs.has_other_subscriber,
        OTHER_PUBLISHER=inputs.has_other_publisher,
        OTHER_OPERATOR=inputs.has_other_operator,
        DEAD_MAN=~is_recent(now, inputs.dead_man_stamp, limits.operator_age),
        STOP_REQUEST=inputs.is_stop_requested,
    )


def faults_of_joints(
    track: JointTrack, inputs: ServoInputs, commanded: Commanded, limits: ServoLimits
) -> tuple[JointTrack, Bits]:
    """What is known of the joints with new positions, and what is wrong with it.

    An arm's joint is where its servo has it: near its command at rest, and as far behind as the lag explains
    in motion. A finger may be stopped by what it holds; it does not leave its command by itself.
    """
    joints, position, is_followed = limits.joints, inputs.joint_pos, commanded.is_followed
    track, is_jump = track.continued(inputs, commanded, limits)
    is_still = track.still_time > FROZEN_TIME
    most = np.minimum(joints.tracking_error, REST_ERROR + joints.lag_error * track.slack)
    of_joints = np.array(
        (
            (position < joints.least) | (position > joints.most) | is_jump,
            np.abs(position - track.explained) > joints.escape,
            np.abs(track.speed) > joints.joint_speed,
            (np.abs(position - commanded.expected) > most) & joints.is_arm,
            is_still & joints.is_arm,
        )
    )
    is_impossible, is_escaped, is_fast, is_off, is_frozen = np.logical_or.reduce(of_joints, axis=-1)
    is_hand_frozen = np.logical_and.reduce(is_still | ~joints.is_finger, axis=-1) & joints.has_fingers
    return track, bits(
        JOINTS_IMPLAUSIBLE=is_impossible | (is_escaped & is_followed),
        JOINT_SPEED=is_fast & is_followed,
        TRACKING_ERROR=is_off & is_followed,
        JOINTS_FROZEN=(is_frozen | is_hand_frozen) & is_followed,
    )


def faults_of_policy(inputs: ServoInputs, limits: ServoLimits) -> Bits:
    """What is wrong with what the policy sees and says."""
    stamps = np.array((inputs.image_stamp, inputs.target_stamp, inputs.box_stamp))
    is_old = ~is_recent(inputs.now, stamps, limits.policy_ages)
    return bits(
        IMAGE_STALE=is_old[0],
        POLICY_LATE=is_old[1],
        TARGET_NOT_FINITE=~np.logical_and.reduce(np.isfinite(inputs.joint_pos_target), axis=-1),
        OBJECT_LOST=is_old[2],
        PERCEPTION_UNSOUND=~inputs.is_perception_sound,
    )


def flag_names(kind: type[IntFlag], found: int) -> list[str]:
    """The flags that are set, in words, such as "image stale"."""
    return [str(flag.name).lower().replace("_", " ") for flag in kind if flag & found] if found else []
