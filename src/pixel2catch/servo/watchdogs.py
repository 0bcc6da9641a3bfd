"""What the servo is told in a tick, and what is wrong with it.

All stamps are of one monotonic clock. A stamp that is no number, or of the future, is as bad as an old one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float64

from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.motion import Bits, Flags, Joints, Rows, Times

JITTER = 0.015  #: How much earlier or later a position may arrive than others do [s]. Source: ours.
SMOOTHING = 0.04  #: Time over which the speed of a joint is estimated [s]. Source: ours.
CLOCK_ERROR = 1e-3  #: How far ahead a stamp may be [s]. Source: ours; processes read the clock in turn.

AnyFlag = TypeVar("AnyFlag", bound=IntFlag)


class Fault(IntFlag):
    """What stops the robot, or keeps it from being armed."""

    CLOCK = 1
    JOINTS_STALE = 2
    JOINTS_NOT_FINITE = 4
    IMAGE_STALE = 8
    POLICY_LATE = 16
    TARGET_NOT_FINITE = 32
    TARGET_FAR = 64
    TRACKING_ERROR = 128
    SAFETY_MODE = 256
    SPEED_SCALING = 512
    OTHER_PUBLISHER = 1024
    DEAD_MAN = 2048
    STOP_REQUEST = 4096
    START_POSE = 8192
    WORKSPACE = 16384
    STILL_STOPPING = 32768
    JOINTS_IMPLAUSIBLE = 65536
    JOINT_SPEED = 131072
    OTHER_OPERATOR = 262144
    SWITCH_NOT_PRESSED = 524288
    OBJECT_LOST = 1048576
    PERCEPTION_UNSOUND = 2097152


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
    has_other_publisher: Flags  #: Whether anybody else sends commands to the robot.
    has_other_operator: Flags  #: Whether several hold the switch, or ask to arm.


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTrack:
    """What has been measured of every joint so far."""

    position: Rows  #: Newest position that was a number [rad].
    stamp: Rows  #: When it was measured [s].
    speed: Rows  #: Estimated speed [rad/s].

    @classmethod
    def unknown(cls, num_rows: int, num_joints: int) -> "JointTrack":
        """Before the first measurement."""
        none = np.full((num_rows, num_joints), np.nan)
        return cls(position=none, stamp=none, speed=0.0 * np.nan_to_num(none))

    def continued(self, position: Rows, stamp: Rows, most: Joints) -> tuple["JointTrack", Flags]:
        """What is known with new positions [rad] of some time [s], and whether one went as none can.

        No joint is faster than `most` [rad/s].
        """
        is_known = np.isfinite(self.stamp)
        is_new = np.isfinite(position) & np.isfinite(stamp) & ~(stamp <= self.stamp)
        elapsed = np.where(is_known & is_new, stamp - self.stamp, 0.0)
        moved = np.where(is_known & is_new, position - self.position, 0.0)
        is_jump = np.abs(moved) > most * (elapsed + JITTER)
        share = np.minimum(elapsed / SMOOTHING, 1.0)
        speed = (1.0 - share) * self.speed + np.where(is_jump, 0.0, moved / np.maximum(elapsed, SMOOTHING))
        track = JointTrack(
            position=np.where(is_new, position, self.position),
            stamp=np.where(is_new, stamp, self.stamp),
            speed=speed,
        )
        return track, np.logical_or.reduce(is_jump, axis=-1)


def is_recent(
    now: Float64[np.ndarray, "*#rows"], stamp: Float64[np.ndarray, "*rows"], age: float | np.ndarray
) -> Bool[np.ndarray, "*rows"]:
    """Whether stamps are of the time up to an age ago [s]."""
    elapsed = now - stamp
    return (elapsed >= -CLOCK_ERROR) & (elapsed <= age)


def all_finite(values: Rows) -> Flags:
    """Whether all joints of a row have a number."""
    return np.logical_and.reduce(np.isfinite(values), axis=-1)


def bits(flags: Mapping[AnyFlag, Flags]) -> Bits:
    """The flags that hold in each row, as one number."""
    return np.array([*flags], dtype=np.int64) @ np.array([*flags.values()])


def faults_of_robot(inputs: ServoInputs, limits: ServoLimits, last_tick: Times) -> Bits:
    """What is wrong with robot, operator and clock, by the inputs and the time of the tick before [s]."""
    now = inputs.now
    elapsed = now - last_tick
    is_joint_measured = is_recent(now[:, None], inputs.joint_stamp, limits.joints.position_age)
    is_measured = np.logical_and.reduce(is_joint_measured, axis=-1)
    return bits(
        {
            Fault.CLOCK: ~((elapsed > 0.0) & (elapsed <= limits.tick_age)),
            Fault.JOINTS_STALE: ~is_measured,
            Fault.JOINTS_NOT_FINITE: ~all_finite(inputs.joint_pos),
            Fault.SAFETY_MODE: ~inputs.is_safe,
            Fault.SPEED_SCALING: ~(inputs.speed_scaling >= 1.0),
            Fault.OTHER_PUBLISHER: inputs.has_other_publisher,
            Fault.OTHER_OPERATOR: inputs.has_other_operator,
            Fault.DEAD_MAN: ~is_recent(now, inputs.dead_man_stamp, limits.operator_age),
            Fault.STOP_REQUEST: inputs.is_stop_requested,
        }
    )


def faults_of_policy(inputs: ServoInputs, limits: ServoLimits) -> Bits:
    """What is wrong with what the policy sees and says."""
    return bits(
        {
            Fault.IMAGE_STALE: ~is_recent(inputs.now, inputs.image_stamp, limits.image_age),
            Fault.POLICY_LATE: ~is_recent(inputs.now, inputs.target_stamp, limits.target_age),
            Fault.TARGET_NOT_FINITE: ~all_finite(inputs.joint_pos_target),
            Fault.OBJECT_LOST: ~is_recent(inputs.now, inputs.box_stamp, limits.box_age),
            Fault.PERCEPTION_UNSOUND: ~inputs.is_perception_sound,
        }
    )


def flag_names(kind: type[IntFlag], found: int) -> list[str]:
    """The flags that are set, in words, such as "image stale"."""
    return [str(flag.name).lower().replace("_", " ") for flag in kind if flag & found]
