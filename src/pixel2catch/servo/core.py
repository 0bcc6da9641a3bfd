"""The servo between policy and robot as a state machine: one tick every 2 ms, no clock, no transport.

    idle ──arm──► armed ──first target──► ramp ──1 s──► run
                  ▲   │                    │             │
                 arm  └──────fault─────────┴────fault────┘
                  │   ▼
                 stopped ──moved by somebody else──► idle

Armed, it holds the pose. In the ramp it goes over to the policy's targets, in the run it follows them: as in
training, a command moves evenly from where it is to the newest target, which it reaches after a control step.
A fault stops: within `STOP_TIME` the commands go to where the joints are measured, and stand still. It takes
a new request to arm for the robot to move again; where somebody else moves the stopped robot, nothing is
sent any more. Whatever the servo is told, no command passes a limit.

Rows are independent robots: one in the laboratory, thousands in tests.
"""

from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag

import numpy as np

from pixel2catch.servo.limits import RETURN_TIME, STOP_TIME, ServoLimits
from pixel2catch.servo.motion import (
    Bits,
    Flags,
    Motion,
    Rows,
    TargetInterpolator,
    Times,
    braked,
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
    motion: Motion  #: The commands.
    hold: Rows  #: The commands when the mode last changed to armed or stopped [rad].
    interpolator: TargetInterpolator  #: The way of the policy's targets.
    expected: Rows  #: Where the joints should be, by the lag of their servos [rad].
    track: JointTrack  #: What has been measured.
    used_press: Times  #: When the switch was pressed that was held at the last stop [s].

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
            track=JointTrack.unknown(num_rows, num_joints),
            used_press=np.full(num_rows, -np.inf),
        )

    def is_in(self, first: Mode, last: Mode | None = None) -> Flags:
        """Which rows are in a mode, or in one of those from the first to the last."""
        if last is None:
            return self.mode == int(first)
        return (self.mode >= int(first)) & (self.mode <= int(last))

    @property
    def is_driven(self) -> Flags:
        """Which rows the policy moves, in the ramp or after it."""
        return self.is_in(Mode.RAMP, Mode.RUN)

    @property
    def is_active(self) -> Flags:
        """Which rows a fault stops."""
        return self.is_in(Mode.ARMED, Mode.RUN)


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
            position=state.motion.position,
            expected=state.expected,
            is_followed=state.is_active & (state.ticks > 0),
        )
        track, of_joints = faults_of_joints(state.track, inputs, commanded, limits)
        joint_pos = np.where(np.isfinite(inputs.joint_pos), inputs.joint_pos, state.motion.position)
        is_far = (np.abs(inputs.joint_pos_target - state.hold) > joints.start_distance).any(axis=-1)
        return cls(
            joint_pos=joint_pos,
            robot=faults_of_robot(inputs, limits, state.now) | of_joints,
            policy=faults_of_policy(inputs, limits)
            | bits({Fault.TARGET_FAR: is_far & state.is_in(Mode.ARMED)}),
            track=track,
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
    is_stop, start = stop != 0, state.is_in(Mode.ARMED) & ((stop | found.policy) == 0)
    run = state.is_in(Mode.RAMP) & (state.ticks * limits.dt >= limits.ramp_time)
    driven = np.where(run, int(Mode.RUN), np.where(start, int(Mode.RAMP), state.mode))
    left = np.where(_was_moved(state, found, limits), int(Mode.IDLE), driven)
    mode = np.where(is_stop, int(Mode.STOPPED), left)
    turned = replace(
        state,
        mode=mode,
        ticks=np.where(mode == state.mode, state.ticks + 1, 0),
        stopped_by=np.where(is_stop, stop, state.stopped_by * (mode == int(Mode.STOPPED))),
        now=inputs.now,
        track=found.track,
        used_press=np.where(is_stop, np.fmax(inputs.pressed_stamp, state.used_press), state.used_press),
        hold=np.where(is_stop[:, None], state.motion.position, state.hold),
    )
    is_new = inputs.arm_stamp > state.arm_stamp
    if not is_new.any():
        return turned, np.zeros_like(stop)
    is_new &= is_recent(inputs.now, inputs.arm_stamp, limits.operator_age)
    asked = is_new & ~state.is_active
    turned = replace(turned, arm_stamp=np.where(is_new, inputs.arm_stamp, state.arm_stamp))
    first = _first_command(state, found, limits)
    refused = _refusals(state, first, found, limits)
    refused |= bits({Fault.SWITCH_NOT_PRESSED: ~(inputs.pressed_stamp > state.used_press)})
    refused = np.where(asked, refused, 0)
    return _armed(turned, asked & (refused == 0), first, found.joint_pos), refused


def _stop(state: ServoState, found: Findings) -> Bits:
    """The faults that stop a row in this tick; armed, it waits for a policy, but for one that makes sense."""
    speaks = state.is_in(Mode.ARMED) & ((found.policy & _LATE) == 0)
    of_policy = found.policy * state.is_driven | (found.policy & _SENSELESS) * speaks
    return found.robot * state.is_active | of_policy


def _was_moved(state: ServoState, found: Findings, limits: ServoLimits) -> Flags:
    """Where somebody else has moved the robot after a stop, such as to its start."""
    if not state.is_in(Mode.STOPPED).any():
        return state.is_in(Mode.STOPPED)
    is_over = state.is_in(Mode.STOPPED) & (state.ticks * limits.dt >= STOP_TIME) & found.is_measured
    is_away = np.abs(found.joint_pos - state.motion.position) > limits.joints.moved_error
    return is_over & is_away.any(axis=-1)


def _first_command(state: ServoState, found: Findings, limits: ServoLimits) -> Rows:
    """Where a row would be armed: where it is measured, or where a stop has left the command [rad]."""
    measured = found.joint_pos.clip(limits.joints.lower, limits.joints.upper)
    return np.where(state.is_in(Mode.IDLE)[:, None], measured, state.motion.position)


def _refusals(state: ServoState, first: Rows, found: Findings, limits: ServoLimits) -> Bits:
    is_off = np.abs(found.joint_pos - first) > limits.joints.start_error
    return found.robot | bits(
        {
            Fault.START_POSE: np.any(is_off, axis=-1),
            Fault.WORKSPACE: ~limits.workspace.contains(first[:, limits.workspace.joints]),
            Fault.STILL_STOPPING: state.is_in(Mode.STOPPED) & (state.ticks * limits.dt < STOP_TIME),
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


class ServoCore:
    """The state machine under some limits.

    Example:
        core = ServoCore(limits)
        state = ServoState.idle(1, limits.num_joints)
        state, output = core.tick(state, inputs)  # every 2 ms
    """

    def __init__(self, limits: ServoLimits) -> None:
        """Keep to limits."""
        self.limits = limits
        self._motion = limits.motion
        self._columns = limits.workspace.joints
        self._arm = self._motion.only(self._columns)
        longest = (self._arm.speed / (self._arm.acceleration * self._arm.dt)).max()
        self._braking_ticks = np.arange(int(np.ceil(longest)) + 1)

    def tick(self, state: ServoState, inputs: ServoInputs) -> tuple[ServoState, Output]:
        """Decide on the commands of this tick; one that is late must not be made up for by two at once."""
        with np.errstate(invalid="ignore", over="ignore"):
            found = Findings.of(state, inputs, self.limits)
            state, refused = changed(state, inputs, found, self.limits)
            state, beyond_limits = self._directed(state, inputs)
            goal, beyond_lead = self._goal(state, found)
            state, held_back = self._moved(state, goal)
        is_idle = state.is_in(Mode.IDLE)
        is_silent = is_idle | ((state.stopped_by & int(Fault.OTHER_PUBLISHER)) != 0)
        clamped = held_back | bits({Clamp.POSITION: beyond_limits, Clamp.LEAD: beyond_lead})
        return state, Output(
            command=np.where(is_silent[:, None], np.nan, state.motion.position),
            mode=state.mode,
            stopped_by=state.stopped_by,
            found=found.robot | found.policy,
            refused=refused,
            clamped=np.where(is_idle, 0, clamped),
        )

    def _directed(self, state: ServoState, inputs: ServoInputs) -> tuple[ServoState, Flags]:
        """The state on its way to the policy's newest target, and whether that is out of limits."""
        joints, target, is_driven = self.limits.joints, inputs.joint_pos_target, state.is_driven
        interpolator = state.interpolator.turned(
            is_driven, target.clip(joints.lower, joints.upper), inputs.now, inputs.target_stamp
        )
        is_out = (target < joints.lower - ROUNDING) | (target > joints.upper + ROUNDING)
        return replace(state, interpolator=interpolator), is_driven & is_out.any(axis=-1)

    def _goal(self, state: ServoState, found: Findings) -> tuple[Rows, Flags]:
        """Where the commands shall go [rad], and whether that is held back to stay near the joints."""
        joints, hold, position = self.limits.joints, state.hold, state.motion.position
        is_driven = state.is_driven[:, None]
        share = np.minimum((state.ticks + 1) * self.limits.dt / self.limits.ramp_time, 1.0)
        share = np.where(state.is_in(Mode.RAMP), share, 1.0)[:, None]
        wanted = hold + share * (state.interpolator.at(state.now + self.limits.dt) - hold)
        near = wanted.clip(found.joint_pos - joints.lead, found.joint_pos + joints.lead)
        returns = state.is_in(Mode.STOPPED) & found.is_measured
        returns &= state.ticks * self.limits.dt < RETURN_TIME
        back = found.joint_pos.clip(hold - joints.lead, hold + joints.lead)
        resting = np.where(state.is_in(Mode.ARMED)[:, None], hold, position)
        goal = np.where(is_driven, near, np.where(returns[:, None], back, resting))
        return goal.clip(joints.lower, joints.upper), ((near != wanted) & is_driven).any(axis=-1)

    def _moved(self, state: ServoState, goal: Rows) -> tuple[ServoState, Bits]:
        """The state a tick further on the way to a goal, and what held it back."""
        motion, limits = state.motion, self._motion
        wish = wished(motion, goal, limits)
        wanted = towards(motion, wish, limits)
        moved = self._kept_inside(motion, wanted, ~state.is_in(Mode.IDLE))
        follow = np.minimum(limits.dt / self.limits.joints.lag, 1.0)
        expected = state.expected + follow * (moved.position - state.expected)
        change = limits.acceleration * limits.dt
        held_back = {
            Clamp.SPEED: (np.abs(wish) > limits.speed).any(axis=-1),
            Clamp.ACCELERATION: (np.abs(wish - motion.velocity) > change + ROUNDING).any(axis=-1),
            Clamp.WORKSPACE: (moved.velocity != wanted.velocity).any(axis=-1),
        }
        return replace(state, motion=moved, expected=expected), bits(held_back)

    def _kept_inside(self, motion: Motion, wanted: Motion, is_watched: Flags) -> Motion:
        """The wanted tick, or as much of it as lets the arm brake without leaving the workspace.

        All joints may brake: that was found a tick ago. One after the other is let go on, if then the arm can
        still brake.
        """
        arm = self._columns
        rows = np.flatnonzero(is_watched & (wanted.velocity[:, arm] != 0.0).any(axis=-1))
        rows = rows[~self._can_stop(wanted.only(rows))] if len(rows) else rows
        if not len(rows):
            return wanted
        braking = braked(motion.only(rows), self._motion)
        position, velocity = wanted.position[rows], wanted.velocity[rows]
        position[:, arm], velocity[:, arm] = braking.position[:, arm], braking.velocity[:, arm]
        for joint in np.flatnonzero((velocity != wanted.velocity[rows]).any(axis=0)):
            trial = Motion(position=position.copy(), velocity=velocity.copy())
            trial.position[:, joint] = wanted.position[rows, joint]
            trial.velocity[:, joint] = wanted.velocity[rows, joint]
            may_go = self._can_stop(trial)[:, None]
            position = np.where(may_go, trial.position, position)
            velocity = np.where(may_go, trial.velocity, velocity)
        kept = Motion(position=wanted.position.copy(), velocity=wanted.velocity.copy())
        kept.position[rows], kept.velocity[rows] = position, velocity
        return kept

    def _can_stop(self, motion: Motion) -> Flags:
        """Whether the arm stays in the workspace at every tick of braking, the present one included."""
        position, velocity = (rows[:, self._columns] for rows in (motion.position, motion.velocity))
        longest = np.ceil(np.abs(velocity) / (self._arm.acceleration * self._arm.dt)).max(axis=-1)
        row, ticks = np.nonzero(self._braking_ticks <= longest[:, None])
        path = braked(Motion(position=position[row], velocity=velocity[row]), self._arm, ticks[:, None])
        is_inside = self.limits.workspace.contains(path.position)
        return np.logical_and.reduceat(is_inside, np.flatnonzero(ticks == 0))
