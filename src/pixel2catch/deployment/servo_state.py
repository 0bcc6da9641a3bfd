"""What the servo remembers from tick to tick, and what it says."""

from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
from jaxtyping import Int64

from pixel2catch.deployment.course import Course
from pixel2catch.deployment.motion import Motion, Rows
from pixel2catch.deployment.watchdog import Bits, Flags, Times


class Mode(IntEnum):
    """What the servo is doing."""

    IDLE = 0
    ARMED = 1
    RAMP = 2
    RUN = 3
    STOPPED = 4


_IDLE, _ARMED, _RAMP, _RUN, _STOPPED = (int(mode) for mode in Mode)


class Clamp(IntFlag):
    """What kept a command from where the policy wants it."""

    POSITION = 1
    LEAD = 2
    SPEED = 4
    ACCELERATION = 8
    WORKSPACE = 16


Modes = Int64[np.ndarray, " rows"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoState:
    """The state of every row.

    Attributes:
        mode: A `Mode`.
        ticks: Ticks since the mode began.
        stopped_by: The `Fault` bits that it was stopped by; none in other modes.
        now: Time of the last tick [s].
        arm_stamp: Stamp of the last request to arm that was heeded, granted or not [s].
        motion: The commands.
        hold: The commands when the mode last changed to armed or stopped [rad].
        course: The way of the policy's targets.
        expected: Where the joints should be, by the lag of their servos [rad].
    """

    mode: Modes
    ticks: Modes
    stopped_by: Bits
    now: Times
    arm_stamp: Times
    motion: Motion
    hold: Rows
    course: Course
    expected: Rows

    @classmethod
    def idle(cls, num_rows: int, num_joints: int) -> "ServoState":
        """The state in which everything begins."""
        zeros, none = np.zeros((num_rows, num_joints)), np.zeros(num_rows, dtype=np.int64)
        return cls(
            mode=none,
            ticks=none,
            stopped_by=none,
            now=np.full(num_rows, np.nan),
            arm_stamp=np.full(num_rows, -np.inf),
            motion=Motion(position=zeros, velocity=zeros),
            hold=zeros,
            course=Course.resting(zeros),
            expected=zeros,
        )

    @property
    def is_idle(self) -> Flags:
        """Which rows send nothing."""
        return self.mode == _IDLE

    @property
    def is_armed(self) -> Flags:
        """Which rows wait for the policy."""
        return self.mode == _ARMED

    @property
    def is_ramping(self) -> Flags:
        """Which rows go over to the policy's targets."""
        return self.mode == _RAMP

    @property
    def is_driven(self) -> Flags:
        """Which rows the policy moves, in the ramp or after it."""
        return (self.mode == _RAMP) | (self.mode == _RUN)

    @property
    def is_active(self) -> Flags:
        """Which rows a fault stops."""
        return (self.mode >= _ARMED) & (self.mode <= _RUN)

    @property
    def is_stopped(self) -> Flags:
        """Which rows were stopped."""
        return self.mode == _STOPPED


@dataclass(frozen=True, kw_only=True, eq=False)
class Output:
    """What the servo says in a tick.

    Attributes:
        command: Commands for the robot [rad]; NaN while idle, when nothing is to be sent.
        mode: A `Mode`.
        stopped_by: `Fault` bits that a stop is for.
        found: `Fault` bits found in this tick, be the robot armed or not.
        refused: `Fault` bits for which a request to arm was refused in this tick.
        clamped: `Clamp` bits: what held the command back in this tick.
    """

    command: Rows
    mode: Modes
    stopped_by: Bits
    found: Bits
    refused: Bits
    clamped: Bits
