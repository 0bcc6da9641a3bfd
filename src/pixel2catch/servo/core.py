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

from dataclasses import replace

import numpy as np

from pixel2catch.servo.limits import RETURN_TIME, ServoLimits
from pixel2catch.servo.motion import Motion, Rows, braked, towards, wished
from pixel2catch.servo.state import NUM_ARM_JOINTS, Clamp, Findings, Output, ServoState, changed
from pixel2catch.servo.watchdogs import Bits, Flags, ServoInputs, bits

ROUNDING = 1e-6
"""Excess of a limit that is rounding: policies are of single precision [rad, rad/s]."""


class ServoCore:
    """The state machine under some limits.

    Example:
        core = ServoCore(ServoLimits())
        state = ServoState.idle(1, len(JOINTS))
        state, output = core.tick(state, inputs)  # every 2 ms
    """

    def __init__(self, limits: ServoLimits) -> None:
        """Keep to limits."""
        self.limits = limits
        self._motion = limits.motion
        self._arm = self._motion.only(slice(0, NUM_ARM_JOINTS))
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
        is_idle = state.is_idle
        clamped = held_back | bits({Clamp.POSITION: beyond_limits, Clamp.LEAD: beyond_lead})
        return state, Output(
            command=np.where(is_idle[:, None], np.nan, state.motion.position),
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
        share = np.where(state.is_ramping, share, 1.0)[:, None]
        wanted = hold + share * (state.interpolator.at(state.now + self.limits.dt) - hold)
        near = wanted.clip(found.joint_pos - joints.lead, found.joint_pos + joints.lead)
        returns = state.is_stopped & found.is_measured
        returns &= state.ticks * self.limits.dt < RETURN_TIME
        back = found.joint_pos.clip(hold - joints.lead, hold + joints.lead)
        resting = np.where(state.is_armed[:, None], hold, position)
        goal = np.where(is_driven, near, np.where(returns[:, None], back, resting))
        return goal.clip(joints.lower, joints.upper), ((near != wanted) & is_driven).any(axis=-1)

    def _moved(self, state: ServoState, goal: Rows) -> tuple[ServoState, Bits]:
        """The state a tick further on the way to a goal, and what held it back."""
        motion, limits = state.motion, self._motion
        wish = wished(motion, goal, limits)
        wanted = towards(motion, wish, limits)
        moved = self._kept_inside(motion, wanted, ~state.is_idle)
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
        arm = slice(0, NUM_ARM_JOINTS)
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
        position, velocity = (rows[:, :NUM_ARM_JOINTS] for rows in (motion.position, motion.velocity))
        longest = np.ceil(np.abs(velocity) / (self._arm.acceleration * self._arm.dt)).max(axis=-1)
        row, ticks = np.nonzero(self._braking_ticks <= longest[:, None])
        path = braked(Motion(position=position[row], velocity=velocity[row]), self._arm, ticks[:, None])
        is_inside = self.limits.workspace.contains(path.position)
        return np.logical_and.reduceat(is_inside, np.flatnonzero(ticks == 0))
