"""Laws of every output of the servo, checked without its own code."""

import numpy as np

from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.servo.link import Fault, Mode
from pixel2catch.servo.state import ServoInputs
from pixel2catch.servo.tick import ServoState
from pixel2catch.servo.workspace import Workspace, note_inside

ROUNDING = 1e-9
ALLOWED = {
    Mode.IDLE: {Mode.IDLE, Mode.ARMED},
    Mode.ARMED: {Mode.ARMED, Mode.RAMP, Mode.STOPPED},
    Mode.RAMP: {Mode.RAMP, Mode.RUN, Mode.STOPPED},
    Mode.RUN: {Mode.RUN, Mode.STOPPED},
    Mode.STOPPED: {Mode.STOPPED, Mode.ARMED, Mode.IDLE},
}
OFF = Fault.SAFETY_MODE | Fault.SPEED_SCALING | Fault.STATUS_UNKNOWN | Fault.CONTROLLER
OFF |= Fault.NO_SUBSCRIBER | Fault.JOINTS_STALE
ACTIVE = (Mode.ARMED, Mode.RAMP, Mode.RUN)
DRIVEN = (Mode.RAMP, Mode.RUN)


class Laws:
    """Check rows of robots tick by tick, and count modes, faults and clamps."""

    def __init__(self, num_rows: int, limits: ServoLimits) -> None:
        self.limits, self.wider = limits, widened(limits.workspace)
        self.travel = np.array([joint.travel for joint in limits.workspace.workcell.joints]).T
        self.mode = np.zeros(num_rows, dtype=np.int64)
        self.stopped_by = np.zeros(num_rows, dtype=np.int64)
        self.command: np.ndarray | None = None
        self.is_silent = np.ones(num_rows, dtype=np.bool_)
        self.change: np.ndarray | None = None
        self.bend: np.ndarray | None = None
        self.last_tick = np.full(num_rows, np.nan)
        self.newest_request = np.full(num_rows, -np.inf)
        self.used_press = np.full(num_rows, -np.inf)
        self.stopped_ticks = np.zeros(num_rows, dtype=np.int64)
        self.ticks_in = np.zeros(len(Mode), dtype=np.int64)
        self.stops_by = {fault: 0 for fault in Fault}
        self.refusals_by = {fault: 0 for fault in Fault}
        self.num_clamps = 0
        #: Largest speed, acceleration and jerk of a command, as shares of its limit.
        self.reached: dict[str, float] = dict.fromkeys(("speed", "acceleration", "jerk"), 0.0)

    def check(self, inputs: ServoInputs, output: ServoState) -> None:
        with np.errstate(invalid="ignore", over="ignore"):
            self._check_modes(inputs, output)
            self._check_faults(inputs, output)
            self._check_motion(inputs, output)
            self._remember(inputs, output)

    def _check_modes(self, inputs: ServoInputs, output: ServoState) -> None:
        for before, after in ALLOWED.items():
            assert np.isin(output["mode"][self.mode == before], list(after)).all()
        is_armed = (output["mode"] == Mode.ARMED) & (self.mode != Mode.ARMED)
        age = inputs.now - inputs.arm_stamp
        is_asked = (inputs.arm_stamp > self.newest_request) & (age < self.limits.operator_age + ROUNDING)
        assert is_asked[is_armed].all(), "armed without a fresh request of its own"
        is_late = self.stopped_ticks * self.limits.dt >= STOP_TIME - ROUNDING
        assert is_late[is_armed & (self.mode == Mode.STOPPED)].all(), "armed in the middle of a stop"
        is_pressed = inputs.pressed_stamp > self.used_press
        assert is_pressed[is_armed].all(), "armed with a switch that was not pressed anew"
        is_left = (output["mode"] == Mode.IDLE) & (self.mode == Mode.STOPPED)
        assert is_late[is_left].all(), "idle in the middle of a stop"
        if self.command is not None:
            was_sent = is_left & ~self.is_silent
            away = (np.abs(inputs.joint_pos - self.command) > self.limits.joints.moved_error).any(axis=-1)
            is_off = ((output["found"] | self.stopped_by) & OFF) != 0
            assert (away | is_off)[was_sent].all(), "idle, but nobody moved the robot or switched it off"
            assert not (is_late & is_off & (output["mode"] == Mode.STOPPED)).any(), "a robot is off, not idle"
        np.testing.assert_array_equal(output["stopped_by"] != 0, output["mode"] == Mode.STOPPED)

    def _check_faults(self, inputs: ServoInputs, output: ServoState) -> None:
        limits, now = self.limits, inputs.now
        joint_age = now[:, None] - inputs.joint_stamp
        is_well = (
            ((now - self.last_tick) > 0.0)
            & ((now - self.last_tick) <= limits.tick_age)
            & (joint_age <= limits.joints.position_age).all(axis=-1)
            & np.isfinite(inputs.joint_pos).all(axis=-1)
            & (now - inputs.dead_man_stamp <= limits.operator_age)
            & ~inputs.is_stop_requested
            & inputs.is_safe
            & (inputs.speed_scaling == 1.0)
            & inputs.is_status_known
            & inputs.has_controller
            & inputs.has_subscriber
            & ~inputs.has_other_subscriber
            & ~inputs.has_other_publisher
            & ~inputs.has_other_operator
            & (inputs.joint_pos > limits.joints.least).all(axis=-1)
            & (inputs.joint_pos < limits.joints.most).all(axis=-1)
        )
        assert is_well[np.isin(output["mode"], ACTIVE)].all()
        sees = (now - inputs.image_stamp <= limits.image_age) & (
            now - inputs.target_stamp <= limits.target_age
        )
        sees &= (now - inputs.box_stamp <= limits.box_age) & inputs.is_perception_sound
        makes_sense = np.isfinite(inputs.joint_pos_target).all(axis=-1)
        assert (sees & makes_sense)[np.isin(output["mode"], DRIVEN)].all()

    def _check_motion(self, inputs: ServoInputs, output: ServoState) -> None:
        limits, joints, command = self.limits, self.limits.joints, output["sent"]
        is_silent = (output["stopped_by"] & Fault.OTHER_PUBLISHER) != 0
        is_sent = (output["mode"] != Mode.IDLE) & ~is_silent
        assert np.isnan(command[~is_sent]).all()
        assert ((command >= joints.lower - ROUNDING) & (command <= joints.upper + ROUNDING))[is_sent].all()
        assert contains(self.wider, command[is_sent][:, :6]).all()
        was_silent = self.is_silent
        first = is_sent & was_silent
        assert (np.abs(command - inputs.joint_pos) <= joints.start_error + ROUNDING)[first].all()
        if self.command is None or self.change is None or self.bend is None:
            return
        change = np.where(was_silent[:, None], 0.0, command - self.command)
        bend = change - np.where(was_silent[:, None], 0.0, self.change)
        kink = bend - np.where(was_silent[:, None], 0.0, self.bend)
        begin, end, deceleration, offset = self.travel
        left = np.maximum(np.where(change > 0.0, end - command, command - begin), 0.0)
        near_end = np.maximum(np.sqrt(2.0 * deceleration * left) - offset, 0.0)
        for name, moved, most in (
            ("speed", change, np.minimum(np.minimum(joints.speed, near_end) * limits.dt, joints.step)),
            ("acceleration", bend, joints.acceleration * limits.dt**2),
            ("jerk", kink, joints.jerk * limits.dt**3),
        ):
            assert (np.abs(moved) <= most + ROUNDING)[is_sent].all(), name
            share = np.abs(moved) / np.maximum(most, ROUNDING)
            self.reached[name] = max(self.reached[name], share[is_sent].max(initial=0.0))
        is_over = (output["mode"] == Mode.STOPPED) & is_sent & (self.stopped_ticks * limits.dt >= STOP_TIME)
        assert not np.abs(change[is_over]).any(), "a stop that still moves"

    def _remember(self, inputs: ServoInputs, output: ServoState) -> None:
        begun = (output["mode"] == Mode.STOPPED) & (self.mode != Mode.STOPPED)
        self.used_press = np.where(begun, inputs.pressed_stamp, self.used_press)
        for fault in Fault:
            self.stops_by[fault] += int((begun & ((output["stopped_by"] & fault) != 0)).sum())
            self.refusals_by[fault] += int(((output["refused"] & fault) != 0).sum())
        self.num_clamps |= int(np.bitwise_or.reduce(output["clamped"]))
        previous = output["sent"] if self.command is None else self.command
        is_new = np.logical_or.reduce(np.isnan(previous) | np.isnan(output["sent"]), axis=-1)
        self.is_silent = np.logical_or.reduce(np.isnan(output["sent"]), axis=-1)
        change = np.where(is_new[:, None], 0.0, output["sent"] - previous)
        self.bend = np.where(is_new[:, None], 0.0, change - (0.0 if self.change is None else self.change))
        self.change = change
        self.command = output["sent"]
        is_still = output["mode"] == Mode.STOPPED
        self.stopped_ticks = np.where(is_still & ~begun, self.stopped_ticks + 1, 0)
        age = inputs.now - inputs.arm_stamp
        is_real = (age >= -0.001 - ROUNDING) & (age <= self.limits.operator_age)
        self.newest_request = np.where(
            is_real, np.fmax(self.newest_request, inputs.arm_stamp), self.newest_request
        )
        self.ticks_in += np.bincount(output["mode"], minlength=len(Mode))
        self.mode, self.last_tick, self.stopped_by = output["mode"], inputs.now, output["stopped_by"]


def widened(workspace: Workspace) -> Workspace:
    lower, upper = np.array(workspace.lower) - ROUNDING, np.array(workspace.upper) + ROUNDING
    return Workspace(
        workcell=workspace.workcell,
        clearance=workspace.clearance - ROUNDING,
        lower=tuple(lower.tolist()),
        upper=tuple(upper.tolist()),
    )


def contains(workspace: Workspace, arm_pos: np.ndarray) -> np.ndarray:
    found = np.empty(len(arm_pos), np.bool_)
    note_inside(workspace.space, np.ascontiguousarray(arm_pos), found)
    return found
