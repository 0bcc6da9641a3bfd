"""Simulated joints that follow their commands, in any number of rows, with a servo; and faults of inputs."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from paper_robot import JOINTS
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Fault
from pixel2catch.servo.state import ServoInputs
from pixel2catch.servo.tick import ServoCore, ServoState
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

HOME = np.array([joint.home for joint in JOINTS])
LIMITS = replace(ServoLimits.of(UR5E_ALLEGRO), ramp_time=0.1)
"""Limits of the robot, with a short ramp."""

TRUE = ("is_perception_sound", "is_safe", "is_status_known", "has_controller", "has_subscriber")
FALSE = (
    "is_planned",
    "is_stop_requested",
    "has_other_publisher",
    "has_other_operator",
    "has_other_subscriber",
)
"""Flags of inputs without a fault."""


def given(**change: np.ndarray) -> Callable[[ServoInputs], ServoInputs]:
    return lambda good: replace(good, **change)


def noisy(good: ServoInputs) -> ServoInputs:
    noise = 1e-5 * np.random.default_rng(int(1e4 * good.now[0])).standard_normal(good.joint_pos.shape)
    return replace(good, joint_pos=good.joint_pos + noise)


class Lab:
    """A servo, and inputs without a fault.

    Joints follow their commands with a lag. The policy sends targets at 30 Hz.
    """

    def __init__(self, num_rows: int = 1, limits: ServoLimits = LIMITS) -> None:
        self.core, self.limits = ServoCore(limits), limits
        self.state = ServoState.idle(num_rows, limits)
        self.rows = num_rows
        self.time = 100.0
        self.target = np.tile(HOME, (num_rows, 1))
        self.joint_pos = self.target.copy()
        self.lag = limits.joints.lag
        self.is_held_fast = np.zeros(len(JOINTS), dtype=bool)
        self._target_stamp = self.pressed = self.time
        self.outputs: list[ServoState] = []
        self.last_inputs = self.inputs()

    def inputs(self) -> ServoInputs:
        now = np.full(self.rows, self.time)
        if self.time - self._target_stamp > CONTROL_DT - 1e-6:
            self._target_stamp = self.time
        return ServoInputs(
            now=now,
            joint_pos=self.joint_pos.copy(),
            joint_stamp=np.tile(now[:, None], len(JOINTS)),
            joint_pos_target=self.target.copy(),
            target_stamp=np.full(self.rows, self._target_stamp),
            image_stamp=now - 0.03,
            box_stamp=now - 0.03,
            dead_man_stamp=now,
            pressed_stamp=np.full(self.rows, self.pressed),
            arm_stamp=np.full(self.rows, -np.inf),
            speed_scaling=np.ones(self.rows),
            **dict.fromkeys(TRUE, np.ones(self.rows, dtype=bool)),
            **dict.fromkeys(FALSE, np.zeros(self.rows, dtype=bool)),
        )

    def tick(self, distort: Callable[[ServoInputs], ServoInputs] | None = None) -> ServoState:
        """Tick with distorted inputs, if a distortion is given, and move the joints."""
        self.time += self.limits.dt
        good = self.inputs()
        self.last_inputs = distort(good) if distort else good
        self.state = output = self.core.tick(self.state, self.last_inputs)
        self.outputs.append(output)
        self.follow(np.where(np.isnan(output["sent"]), self.joint_pos, output["sent"]))
        return output

    def follow(self, command: np.ndarray) -> None:
        share = np.minimum(self.limits.dt / self.lag, 1.0)
        self.joint_pos += np.where(self.is_held_fast, 0.0, share * (command - self.joint_pos))

    def run(self, seconds: float, distort: Callable[[ServoInputs], ServoInputs] | None = None) -> ServoState:
        for _ in range(round(seconds / self.limits.dt) - 1):
            self.tick(distort)
        return self.tick(distort)

    def arm(self) -> ServoState:
        self.tick()
        return self.request_arm()

    def request_arm(self) -> ServoState:
        self.pressed = self.time
        return self.tick(lambda good: replace(good, arm_stamp=good.now))

    def swung(self) -> "Lab":
        """Run to the middle of a fast motion of the arm."""
        self.started()
        for way, seconds in ((0.4, 0.1), (-0.4, 0.5), (0.4, 0.05)):
            self.target[:, :3] += way * np.array((1.0, -1.0, -1.0))
            self.run(seconds)
        return self

    def started(self) -> "Lab":
        """Arm, and run to the end of the ramp."""
        self.arm()
        self.run(self.limits.ramp_time + 0.05)
        return self


ELBOW = np.arange(len(JOINTS)) == 2


def aged(seconds: float) -> Callable[[ServoInputs], np.ndarray]:
    return lambda good: good.now - seconds


def elbow(value: float, field: str) -> Callable[[ServoInputs], np.ndarray]:
    return lambda good: np.where(ELBOW, value, getattr(good, field))


def finger(value: float) -> Callable[[ServoInputs], np.ndarray]:
    return lambda good: np.where(np.arange(len(JOINTS)) == 8, value, good.joint_pos)


def always(value: float | bool) -> Callable[[ServoInputs], np.ndarray]:
    return lambda good: np.full(len(good.now), value)


MISHAPS: tuple[tuple[Fault, str, Callable[[ServoInputs], np.ndarray]], ...] = (
    (Fault.IMAGE_STALE, "image_stamp", aged(0.11)),
    (Fault.IMAGE_STALE, "image_stamp", aged(-0.01)),
    (Fault.IMAGE_STALE, "image_stamp", always(np.nan)),
    (Fault.OBJECT_LOST, "box_stamp", aged(3.01)),
    (Fault.OBJECT_LOST, "box_stamp", always(np.nan)),
    (Fault.PERCEPTION_UNSOUND, "is_perception_sound", always(False)),
    (Fault.POLICY_LATE, "target_stamp", aged(0.07)),
    (Fault.TARGET_NOT_FINITE, "joint_pos_target", elbow(np.nan, "joint_pos_target")),
    (Fault.TARGET_NOT_FINITE, "joint_pos_target", elbow(-np.inf, "joint_pos_target")),
    (Fault.JOINTS_STALE, "joint_stamp", lambda good: good.joint_stamp - 0.021 * ELBOW),
    (Fault.JOINTS_NOT_FINITE, "joint_pos", elbow(np.nan, "joint_pos")),
    (Fault.JOINTS_IMPLAUSIBLE, "joint_pos", lambda good: good.joint_pos + 0.08 * ELBOW),
    (Fault.JOINTS_IMPLAUSIBLE, "joint_pos", finger(100.0)),
    (Fault.JOINTS_IMPLAUSIBLE, "joint_pos", finger(-7.0)),
    (Fault.JOINTS_IMPLAUSIBLE, "joint_pos", finger(1e308)),
    (Fault.SAFETY_MODE, "is_safe", always(False)),
    (Fault.SPEED_SCALING, "speed_scaling", always(0.99)),
    *((Fault.SPEED_SCALING, "speed_scaling", always(value)) for value in (np.nan, np.inf, -1.0, 1.01)),
    (Fault.STATUS_UNKNOWN, "is_status_known", always(False)),
    (Fault.CONTROLLER, "has_controller", always(False)),
    (Fault.NO_SUBSCRIBER, "has_subscriber", always(False)),
    (Fault.OTHER_SUBSCRIBER, "has_other_subscriber", always(True)),
    (Fault.OTHER_PUBLISHER, "has_other_publisher", always(True)),
    (Fault.OTHER_OPERATOR, "has_other_operator", always(True)),
    (Fault.DEAD_MAN, "dead_man_stamp", aged(0.21)),
    (Fault.STOP_REQUEST, "is_stop_requested", always(True)),
    (Fault.CLOCK, "now", always(np.nan)),
    (Fault.CLOCK, "now", aged(0.003)),
    (Fault.CLOCK, "now", aged(-0.021)),
)
"""Faults that stop the robot, one row each; a wrong clock also makes stamps wrong."""


def all_at_once(good: ServoInputs) -> ServoInputs:
    """Inputs in which each row has its own fault."""
    change: dict[str, np.ndarray] = {}
    for row, (_, field, value) in enumerate(MISHAPS):
        change.setdefault(field, getattr(good, field).copy())[row] = value(good)[row]
    return replace(good, **change)


def one(number: int) -> Callable[[ServoInputs], ServoInputs]:
    """Inputs in which all rows have the same fault."""
    _, field, value = MISHAPS[number]
    return lambda good: replace(good, **{field: value(good)})
