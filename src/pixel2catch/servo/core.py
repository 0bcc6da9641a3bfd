"""The servo between policy and robot as a state machine: one tick every 2 ms, no clock, no transport.

    idle ──arm──► armed ──first target──► ramp ──1 s──► run
                  ▲   │                    │             │
                 arm  └──────fault─────────┴────fault────┘
                  │   ▼
                 stopped ──moved by somebody else──► idle

Armed, it holds the pose. In the ramp it goes over to the policy's targets, in the run it follows them: as in
training, a command moves evenly from where it is to the newest target, which it reaches after a control step.
A fault stops: evenly the commands give up their lead of the joints, which slows these down evenly whatever
their lag is, and within `STOP_TIME` they stand still. Where joints are not measured the commands slow down as
evenly. It takes a new request to arm for the robot to move again; where somebody else moves the stopped
robot, nothing is sent any more. Whatever the servo is told, no command passes a limit.

Rows are independent robots: one in the laboratory, thousands in tests.
"""

from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag
from functools import cached_property

import numpy as np
from jaxtyping import Bool

from pixel2catch.servo.braking import WorkspaceBrake
from pixel2catch.servo.limits import RETURN_TIME, STOP_TIME, ServoLimits
from pixel2catch.servo.motion import (
    Bits,
    Flags,
    Motion,
    Recent,
    Rows,
    TargetInterpolator,
    Times,
    averaged,
    clipped,
    towards,
    wished,
)
from pixel2catch.servo.watchdogs import (
    Commanded,
    Fault,
    JointTrack,
    ServoInputs,
    bits,
    faults_of_joints,
    faults_of_policy,
    faults_of_robot,
    is_recent,
)

ROUNDING = 1e-6  #: Excess of a limit that is rounding: policies are of single precision [rad, rad/s].


class Mode(IntEnum):
    """What the servo is doing."""

    IDLE = 0
    ARMED = 1
    RAMP = 2
    RUN = 3
    STOPPED = 4


AnyFlags = Bool[np.ndarray, "rows joints"]


class Clamp(IntFlag):
    """What kept a command from where the policy wants it."""

    POSITION = 1
    LEAD = 2
    SPEED = 4
    ACCELERATION = 8
    WORKSPACE = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class ServoState:
    """The state of every row."""

    mode: Bits  #: A `Mode`.
    ticks: Bits  #: Ticks since the mode began.
    stopped_by: Bits  #: The `Fault` bits that it was stopped by; none in other modes.
    now: Times  #: Time of the last tick [s].
    arm_stamp: Times  #: Stamp of the last request to arm that was heeded, granted or not [s].
    motion: Motion  #: Where the commands are on their way to.
    recent: Recent  #: Newest positions of that motion, oldest first [rad].
    command: Rows  #: The commands, which are their means [rad].
    hold: Rows  #: The commands when the mode last changed to armed or stopped [rad].
    lead: Rows  #: How far they were ahead of the joints at the last stop [rad].
    is_returning: Flags  #: Whether the joints have been measured since that stop.
    interpolator: TargetInterpolator  #: The way of the policy's targets.
    expected: Rows  #: Where the joints should be, by the lag of their servos [rad].
    track: JointTrack  #: What has been measured.
    used_press: Times  #: When the switch was pressed that was held at the last stop [s].

    @classmethod
    def idle(cls, num_rows: int, limits: ServoLimits) -> "ServoState":
        """The state in which everything begins."""
        zeros, none = np.zeros((num_rows, limits.num_joints)), np.zeros(num_rows, dtype=np.int64)
        return cls(
            mode=none,
            ticks=none,
            stopped_by=none,
            now=np.full(num_rows, np.nan),
            arm_stamp=np.full(num_rows, -np.inf),
            motion=Motion(position=zeros, velocity=zeros),
            recent=np.zeros((len(limits.motion.weights), *zeros.shape)),
            command=zeros,
            hold=zeros,
            lead=zeros,
            is_returning=none > 0,
            interpolator=TargetInterpolator.resting(zeros),
            expected=zeros,
            track=JointTrack.unknown(num_rows, limits.num_joints),
            used_press=np.full(num_rows, -np.inf),
        )

    def is_in(self, mode: Mode) -> Flags:
        """Which rows are in a mode."""
        return self.mode == int(mode)

    @cached_property
    def is_driven(self) -> Flags:
        """Which rows the policy moves, in the ramp or after it."""
        return (self.mode >= int(Mode.RAMP)) & (self.mode <= int(Mode.RUN))

    @property
    def is_left_to_others(self) -> Flags:
        """Which rows are stopped because somebody else commands the robot: nothing is sent to it."""
        return (self.stopped_by & int(Fault.OTHER_PUBLISHER)) != 0

    @cached_property
    def is_active(self) -> Flags:
        """Which rows a fault stops."""
        return (self.mode >= int(Mode.ARMED)) & (self.mode <= int(Mode.RUN))


@dataclass(frozen=True, kw_only=True, eq=False)
class Output:
    """What the servo says in a tick."""

    #: Commands for the robot [rad]; NaN where nothing is to be sent: while idle, and after a stop because
    #: somebody else commands the robot, whom it must not fight.
    command: Rows
    mode: Bits  #: A `Mode`.
    stopped_by: Bits  #: `Fault` bits that a stop is for.
    found: Bits  #: `Fault` bits found in this tick, be the robot armed or not.
    refused: Bits  #: `Fault` bits for which a request to arm was refused in this tick.
    clamped: Bits  #: `Clamp` bits: what held the command back in this tick.


_CLAMPS = np.array([*Clamp], dtype=np.int64)
_STOPPED = int(Mode.STOPPED)
_LATE = int(Fault.POLICY_LATE)
_SENSELESS = int(Fault.TARGET_NOT_FINITE | Fault.TARGET_FAR)
_NOT_MEASURED = int(Fault.JOINTS_STALE | Fault.JOINTS_NOT_FINITE | Fault.JOINTS_IMPLAUSIBLE)


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """What a tick is about."""

    joint_pos: Rows  #: Measured joint positions [rad]; the command where there is no number.
    robot: Bits  #: `Fault` bits of robot, operator and clock.
    policy: Bits  #: `Fault` bits of what the policy sees and says.
    track: JointTrack  #: What has been measured up to now.

    @classmethod
    def of(cls, state: ServoState, inputs: ServoInputs, limits: ServoLimits) -> "Findings":
        """Look at everything."""
        joints = limits.joints
        commanded = Commanded(
            position=state.command,
            expected=state.expected,
            is_followed=state.is_active & (state.ticks > 0),
        )
        track, of_joints = faults_of_joints(state.track, inputs, commanded, limits)
        policy, is_armed = faults_of_policy(inputs, limits), state.is_in(Mode.ARMED)
        if is_armed.any():
            is_far = np.abs(inputs.joint_pos_target - state.hold) > joints.start_distance
            policy |= bits(TARGET_FAR=is_far.any(axis=-1) & is_armed)
        return cls(
            joint_pos=np.where(inputs.is_measured, inputs.joint_pos, state.command),
            robot=faults_of_robot(inputs, limits, state.now) | of_joints,
            policy=policy,
            track=track,
        )

    @property
    def is_measured(self) -> Flags:
        """Whether the positions of all joints are fresh numbers."""
        return (self.robot & _NOT_MEASURED) == 0


def of_any_joint(*flags: AnyFlags) -> Bool[np.ndarray, "kinds rows"]:
    """Which flags hold of any joint of a row."""
    return np.logical_or.reduce(flags, axis=-1)


def changed(
    state: ServoState, inputs: ServoInputs, found: Findings, limits: ServoLimits
) -> tuple[ServoState, Bits]:
    """The state in its mode of this tick, and the faults for which a request to arm was refused."""
    stop = _stop(state, found)
    is_stop, mode = stop != 0, _next_mode(state, found, stop, limits)
    turned = replace(
        state,
        mode=mode,
        ticks=np.where(mode == state.mode, state.ticks + 1, 0),
        stopped_by=np.where(is_stop, stop, state.stopped_by * (mode == _STOPPED)),
        now=inputs.now,
        track=found.track,
        is_returning=(is_stop | state.is_returning) & found.is_measured,
    )
    if np.count_nonzero(is_stop):
        rows = is_stop[:, None]
        turned = replace(
            turned,
            used_press=np.where(is_stop, np.fmax(inputs.pressed_stamp, state.used_press), state.used_press),
            hold=np.where(rows, state.command, state.hold),
            lead=np.where(rows, state.command - found.joint_pos, state.lead),
        )
    is_new = inputs.arm_stamp > state.arm_stamp
    if not np.count_nonzero(is_new):
        return turned, np.zeros_like(stop)
    is_new &= is_recent(inputs.now, inputs.arm_stamp, limits.operator_age)
    asked = is_new & ~state.is_active
    turned = replace(turned, arm_stamp=np.where(is_new, inputs.arm_stamp, state.arm_stamp))
    first = _first_command(state, found, limits)
    refused = _refusals(state, first, found, limits)
    refused |= bits(SWITCH_NOT_PRESSED=~(inputs.pressed_stamp > state.used_press))
    refused = np.where(asked, refused, 0)
    return _armed(turned, asked & (refused == 0), first, found.joint_pos), refused


def _stop(state: ServoState, found: Findings) -> Bits:
    """The faults that stop a row in this tick; armed, it waits for a policy, but for one that makes sense."""
    faults = found.robot | found.policy
    if not np.count_nonzero(faults):
        return faults
    speaks = state.is_in(Mode.ARMED) & ((found.policy & _LATE) == 0)
    of_policy = found.policy * state.is_driven | (found.policy & _SENSELESS) * speaks
    return found.robot * state.is_active | of_policy


def _next_mode(state: ServoState, found: Findings, stop: Bits, limits: ServoLimits) -> Bits:
    """The modes of this tick, by the faults that stop."""
    if np.count_nonzero(state.is_in(Mode.RUN)) == len(stop) and not np.count_nonzero(stop):
        return state.mode
    start = state.is_in(Mode.ARMED) & ((stop | found.policy) == 0)
    run = state.is_in(Mode.RAMP) & (state.ticks * limits.dt >= limits.ramp_time)
    driven = np.where(run, int(Mode.RUN), np.where(start, int(Mode.RAMP), state.mode))
    left = np.where(_was_moved(state, found, limits), int(Mode.IDLE), driven)
    return np.where(stop != 0, _STOPPED, left)


def _was_moved(state: ServoState, found: Findings, limits: ServoLimits) -> Flags:
    """Where somebody else has moved the robot after a stop, such as to its start."""
    if not state.is_in(Mode.STOPPED).any():
        return state.is_in(Mode.STOPPED)
    is_over = state.is_in(Mode.STOPPED) & (state.ticks * limits.dt >= STOP_TIME) & found.is_measured
    is_away = np.abs(found.joint_pos - state.command) > limits.joints.moved_error
    return is_over & is_away.any(axis=-1)


def _first_command(state: ServoState, found: Findings, limits: ServoLimits) -> Rows:
    """Where a row would be armed: where a stop has left the command, or where it is measured [rad]."""
    measured = found.joint_pos.clip(limits.joints.lower, limits.joints.upper)
    is_free = state.is_in(Mode.IDLE) | state.is_left_to_others
    return np.where(is_free[:, None], measured, state.command)


def _refusals(state: ServoState, first: Rows, found: Findings, limits: ServoLimits) -> Bits:
    is_off = np.abs(found.joint_pos - first) > limits.joints.start_error
    return found.robot | bits(
        START_POSE=np.any(is_off, axis=-1),
        WORKSPACE=~limits.workspace.contains(first[:, limits.workspace.joints]),
        STILL_STOPPING=state.is_in(Mode.STOPPED) & (state.ticks * limits.dt < STOP_TIME),
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
        recent=np.where(rows, first, state.recent),
        command=np.where(rows, first, state.command),
        hold=np.where(rows, first, state.hold),
        interpolator=state.interpolator.rested(arm, first),
        expected=np.where(rows, joint_pos, state.expected),
    )


class ServoCore:
    """The state machine under some limits.

    Example:
        core = ServoCore(limits)
        state = ServoState.idle(1, limits)
        state, output = core.tick(state, inputs)  # every 2 ms
    """

    def __init__(self, limits: ServoLimits) -> None:
        """Keep to limits."""
        self.limits = limits
        self._motion = limits.motion
        self._brake = WorkspaceBrake(limits.workspace, self._motion)
        self._even_speed = limits.joints.lead / limits.joints.lag
        #: Speed of commands at which no joint is too fast, whatever its lag [rad/s]: an arm's, until it is
        #: seen.
        self._unseen_speed = np.where(limits.joints.is_arm, self._even_speed, np.inf)
        self._ahead = limits.dt + self._motion.delay
        self._stop_reach = limits.joints.lead + 0.5 * self._even_speed * limits.joints.stop_time
        self._sudden = self._motion.change + ROUNDING

    def tick(self, state: ServoState, inputs: ServoInputs) -> tuple[ServoState, Output]:
        """Decide on the commands of this tick; one that is late must not be made up for by two at once."""
        joints, target = self.limits.joints, inputs.joint_pos_target
        with np.errstate(invalid="ignore", over="ignore"):
            found = Findings.of(state, inputs, self.limits)
            state, refused = changed(state, inputs, found, self.limits)
            allowed = clipped(target, joints.lower, joints.upper)
            is_out = (np.abs(allowed - target) > ROUNDING) & state.is_driven[:, None]
            way = state.interpolator.turned(state.is_driven, allowed, inputs.now, inputs.target_stamp)
            goal, is_led = self._goal(state, found, way)
            state, held_back = self._moved(state, found, way, goal)
        is_silent = state.is_in(Mode.IDLE) | state.is_left_to_others
        return state, Output(
            command=np.where(is_silent[:, None], np.nan, state.command),
            mode=state.mode,
            stopped_by=state.stopped_by,
            found=found.robot | found.policy,
            refused=refused,
            clamped=_CLAMPS @ of_any_joint(is_out, is_led, *held_back),
        )

    def _goal(self, state: ServoState, found: Findings, way: TargetInterpolator) -> tuple[Rows, AnyFlags]:
        """Where armed robots shall go [rad], and which joints are held back to stay near where they are."""
        joints, hold, is_driven = self.limits.joints, state.hold, state.is_driven[:, None]
        share = np.minimum((state.ticks + 1) * self.limits.dt / self.limits.ramp_time, 1.0)
        share = np.where(state.is_in(Mode.RAMP), share, 1.0)[:, None]
        wanted = hold + share * (way.at(state.now, self._ahead) - hold)
        reach = self._even_speed * (found.track.lag + self._motion.delay)
        near = clipped(wanted, found.joint_pos - reach, found.joint_pos + reach)
        goal = clipped(np.where(is_driven, near, hold), joints.lower, joints.upper)
        return goal, (near != wanted) & is_driven

    def _stopping(self, state: ServoState, found: Findings) -> Rows:
        """Speeds that bring what is not armed to rest [rad/s]."""
        joints, motion, dt = self.limits.joints, state.motion, self.limits.dt
        left = joints.stop_time - state.ticks[:, None] * dt
        slower = motion.velocity.clip(-self._even_speed, self._even_speed)
        slower *= np.maximum(1.0 - dt / np.maximum(left, dt), 0.0)
        if not state.is_returning.any():
            return slower
        is_returning = state.is_returning & (state.ticks * dt < RETURN_TIME)
        speed = np.where(left > 0.0, found.track.speed - state.lead / joints.stop_time, 0.0)
        back = found.joint_pos + state.lead * np.maximum(left / joints.stop_time, 0.0) + speed * self._ahead
        back = clipped(back, state.hold - self._stop_reach, state.hold + self._stop_reach)
        back = speed + wished(motion, clipped(back, joints.lower, joints.upper), self._motion)
        return np.where(is_returning[:, None], back, slower)

    def _moved(
        self, state: ServoState, found: Findings, way: TargetInterpolator, goal: Rows
    ) -> tuple[ServoState, tuple[AnyFlags, AnyFlags, AnyFlags]]:
        """The state a tick further, and which joints speed, acceleration and the workspace have held back."""
        motion, limits = state.motion, self._motion
        wish, is_active = wished(motion, goal, limits), state.is_active
        slow = np.where(found.track.is_lag_seen, np.inf, self._unseen_speed)
        wish = clipped(wish, -slow, slow)
        if np.count_nonzero(is_active) < len(is_active):
            wish = np.where(is_active[:, None], wish, self._stopping(state, found))
        wanted = towards(motion, wish, limits)
        moved = self._brake.kept_inside(motion, state.recent, wanted, state.mode != int(Mode.IDLE))
        recent = np.concatenate((state.recent[1:], moved.position[None]))
        command = averaged(recent, limits)
        moved_state = replace(
            state,
            motion=moved,
            recent=recent,
            command=command,
            interpolator=way,
            expected=found.track.expected(state.expected, command, self.limits),
        )
        is_fast, is_sudden = np.abs(wish) > limits.speed, np.abs(wish - motion.velocity) > self._sudden
        return moved_state, (is_fast, is_sudden, moved.velocity != wanted.velocity)
