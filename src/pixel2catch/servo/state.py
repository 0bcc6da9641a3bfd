"""What the servo remembers from tick to tick, and what it says."""

from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag

import numpy as np
from jaxtyping import Int64

from pixel2catch.scene.constants import ARM_JOINTS
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.motion import Motion, Rows, TargetInterpolator
from pixel2catch.servo.watchdogs import (
    Bits,
    Fault,
    Flags,
    ServoInputs,
    Times,
    bits,
    faults_of_policy,
    faults_of_robot,
    is_recent,
)


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
        interpolator: The way of the policy's targets.
        expected: Where the joints should be, by the lag of their servos [rad].
    """

    mode: Modes
    ticks: Modes
    stopped_by: Bits
    now: Times
    arm_stamp: Times
    motion: Motion
    hold: Rows
    interpolator: TargetInterpolator
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
            interpolator=TargetInterpolator.resting(zeros),
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


NUM_ARM_JOINTS = len(ARM_JOINTS)

_LATE = int(Fault.POLICY_LATE)
_SENSELESS = int(Fault.TARGET_NOT_FINITE | Fault.TARGET_FAR)
_NOT_MEASURED = int(Fault.JOINTS_STALE | Fault.JOINTS_NOT_FINITE)


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """What a tick is about.

    Attributes:
        joint_pos: Measured joint positions [rad]; the command where there is no number.
        robot: `Fault` bits of robot, operator and clock.
        policy: `Fault` bits of what the policy sees and says.
    """

    joint_pos: Rows
    robot: Bits
    policy: Bits

    @classmethod
    def of(cls, state: ServoState, inputs: ServoInputs, limits: ServoLimits) -> "Findings":
        """Look at everything."""
        joints = limits.joints
        joint_pos = np.where(np.isfinite(inputs.joint_pos), inputs.joint_pos, state.motion.position)
        is_off = (np.abs(joint_pos - state.expected) > joints.tracking_error).any(axis=-1)
        is_far = (np.abs(inputs.joint_pos_target - state.hold) > joints.start_distance).any(axis=-1)
        return cls(
            joint_pos=joint_pos,
            robot=faults_of_robot(inputs, limits, state.now)
            | bits({Fault.TRACKING_ERROR: is_off & state.is_active}),
            policy=faults_of_policy(inputs, limits) | bits({Fault.TARGET_FAR: is_far & state.is_armed}),
        )

    @property
    def is_measured(self) -> Flags:
        """Whether the positions of all joints are fresh numbers."""
        return (self.robot & _NOT_MEASURED) == 0


def changed(
    state: ServoState, inputs: ServoInputs, found: Findings, limits: ServoLimits
) -> tuple[ServoState, Bits]:
    """The state in its mode of this tick, and the faults for which a request to arm was refused."""
    stop = _stop(state, found)
    is_stop, start = stop != 0, state.is_armed & ((stop | found.policy) == 0)
    run = state.is_ramping & (state.ticks * limits.dt >= limits.ramp_time)
    driven = np.where(run, int(Mode.RUN), np.where(start, int(Mode.RAMP), state.mode))
    left = np.where(_was_moved(state, found, limits), int(Mode.IDLE), driven)
    mode = np.where(is_stop, int(Mode.STOPPED), left)
    turned = replace(
        state,
        mode=mode,
        ticks=np.where(mode == state.mode, state.ticks + 1, 0),
        stopped_by=np.where(is_stop, stop, state.stopped_by * (mode == int(Mode.STOPPED))),
        now=inputs.now,
        hold=np.where(is_stop[:, None], state.motion.position, state.hold),
    )
    is_new = inputs.arm_stamp > state.arm_stamp
    if not is_new.any():
        return turned, np.zeros_like(stop)
    is_new &= is_recent(inputs.now, inputs.arm_stamp, limits.operator_age)
    asked = is_new & ~state.is_active
    turned = replace(turned, arm_stamp=np.where(is_new, inputs.arm_stamp, state.arm_stamp))
    first = _first_command(state, found, limits)
    refused = np.where(asked, _refusals(state, first, found, limits), 0)
    return _armed(turned, asked & (refused == 0), first, found.joint_pos), refused


def _stop(state: ServoState, found: Findings) -> Bits:
    """The faults that stop a row in this tick; armed, it waits for a policy, but for one that makes sense."""
    speaks = state.is_armed & ((found.policy & _LATE) == 0)
    of_policy = found.policy * state.is_driven | (found.policy & _SENSELESS) * speaks
    return found.robot * state.is_active | of_policy


def _was_moved(state: ServoState, found: Findings, limits: ServoLimits) -> Flags:
    """Where somebody else has moved the robot after a stop, such as to its start."""
    if not state.is_stopped.any():
        return state.is_stopped
    is_over = state.is_stopped & (state.ticks * limits.dt >= STOP_TIME) & found.is_measured
    is_away = np.abs(found.joint_pos - state.motion.position) > limits.joints.moved_error
    return is_over & is_away.any(axis=-1)


def _first_command(state: ServoState, found: Findings, limits: ServoLimits) -> Rows:
    """Where a row would be armed: where it is measured, or where a stop has left the command [rad]."""
    measured = found.joint_pos.clip(limits.joints.lower, limits.joints.upper)
    return np.where(state.is_idle[:, None], measured, state.motion.position)


def _refusals(state: ServoState, first: Rows, found: Findings, limits: ServoLimits) -> Bits:
    is_off = np.abs(found.joint_pos - first) > limits.joints.start_error
    return found.robot | bits(
        {
            Fault.START_POSE: np.any(is_off, axis=-1),
            Fault.WORKSPACE: ~limits.workspace.contains(first[:, :NUM_ARM_JOINTS]),
            Fault.STILL_STOPPING: state.is_stopped & (state.ticks * limits.dt < STOP_TIME),
        }
    )


def _armed(state: ServoState, arm: Flags, first: Rows, joint_pos: Rows) -> ServoState:
    """The state with some rows armed, at rest at their first command."""
    rows = arm[:, None]
    return replace(
        state,
        mode=np.where(arm, int(Mode.ARMED), state.mode),
        ticks=np.where(arm, 0, state.ticks),
        stopped_by=np.where(arm, 0, state.stopped_by),
        motion=Motion(
            position=np.where(rows, first, state.motion.position),
            velocity=np.where(rows, 0.0, state.motion.velocity),
        ),
        hold=np.where(rows, first, state.hold),
        interpolator=state.interpolator.rested(arm, first),
        expected=np.where(rows, joint_pos, state.expected),
    )
