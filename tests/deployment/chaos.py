"""Random inputs of the servo: many of them faulty."""

import numpy as np
from servo_rows import HOME

from paper_robot import JOINTS
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.state import ServoInputs

STRANGE = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e3, 0.0])
WRONG_STAMPS = np.array([np.nan, np.inf, -np.inf, 0.0])
RECKLESSNESS = np.array([0.0, 3e-4, 1e-3, 1e-2])
"""Chance of each mishap in a tick; a quarter of the labs each."""

SENDERS = ("joint_stamp", "target_stamp", "image_stamp", "dead_man_stamp")


class Chaos:
    """Inputs of `num_rows` servos: call `inputs`, tick, and call `follow` with the commands.

    Joints follow their commands with their own lag, some of them badly. Encoders are frozen at the last
    value, scaled or shifted at times.
    """

    def __init__(self, num_rows: int, limits: ServoLimits, seed: int) -> None:
        self.random, self.limits, self.rows = np.random.default_rng(seed), limits, num_rows
        self.time = np.full(num_rows, 1000.0)
        self.chance = RECKLESSNESS[np.arange(num_rows) % len(RECKLESSNESS)]
        start = self._pose(0.1)
        self.share = np.minimum(limits.dt / limits.joints.lag, 1.0) * self.random.uniform(
            0.7, 1.4, (num_rows, 1)
        )
        self.joint_pos = start
        self.target, self.pressed = start.copy(), self.time.copy()
        self.measured, zeros = start.copy(), np.zeros(start.shape)
        self.scale, self.offset, self.is_frozen, self.until = zeros + 1.0, zeros, zeros > 0.0, self.time
        self.sent = {name: self.time.copy() for name in SENDERS}
        self.silent_until = {name: self.time - 1.0 for name in SENDERS}

    def inputs(self) -> ServoInputs:
        self.time = self.time + self.limits.dt * self.random.uniform(0.5, 1.5, self.rows)
        self._decide()
        self._send()
        self.pressed = np.where(self.random.random(self.rows) < 0.02, self.time, self.pressed)
        now = self._wrong(self.time, WRONG_STAMPS)
        self._measure()
        joint_stamp = np.tile(self.sent["joint_stamp"][:, None], len(JOINTS))
        return ServoInputs(
            now=np.where(self._happens(), now - self.random.exponential(0.1, self.rows), now),
            joint_pos=self._wrong(self.measured, STRANGE),
            joint_stamp=self._wrong(joint_stamp, WRONG_STAMPS),
            joint_pos_target=self._wrong(self.target, STRANGE),
            target_stamp=self._wrong(self.sent["target_stamp"], WRONG_STAMPS),
            image_stamp=self._wrong(self.sent["image_stamp"], WRONG_STAMPS),
            box_stamp=self._wrong(self.sent["image_stamp"], WRONG_STAMPS),
            is_perception_sound=~self._happens(),
            is_planned=self._happens(),
            dead_man_stamp=self._wrong(self.sent["dead_man_stamp"], WRONG_STAMPS),
            pressed_stamp=self.pressed,
            arm_stamp=self._requests(),
            is_stop_requested=self._happens(),
            is_safe=~self._happens(),
            speed_scaling=np.where(
                self._happens(), self.random.choice([0.0, 0.9, 1.1, np.inf, np.nan], self.rows), 1.0
            ),
            is_status_known=~self._happens(),
            has_controller=~self._happens(),
            has_other_publisher=self._happens(),
            has_other_operator=self._happens(),
            has_subscriber=~self._happens(),
            has_other_subscriber=self._happens(),
        )

    def follow(self, command: np.ndarray) -> None:
        """Move the robots; some are blocked, pushed, or moved away while nothing is sent."""
        goal = np.where(np.isnan(command), self.joint_pos, command)
        joint_pos = self.joint_pos + self.share * (goal - self.joint_pos)
        bump = self._happens()[:, None] * self.random.normal(0.0, 0.5, joint_pos.shape)
        away = np.isnan(command).any(axis=-1) & (self.random.random(self.rows) < 0.01)
        spread = self.random.choice([0.1, 0.1, 0.5, 3.0])
        self.joint_pos = np.where(away[:, None], self._pose(spread), joint_pos + bump)
        stuck = self._happens() & (self.random.random(self.rows) < 0.2)
        self.share = np.where(stuck[:, None], 0.0, self.share)

    def _measure(self) -> None:
        """Begin and end errors of encoders of one joint or of all: offset, scale, or freeze."""
        shape, is_past = self.measured.shape, (self.time > self.until)[:, None]
        begins = self._happens()[:, None] & is_past
        is_over = is_past & ~begins
        kind = np.where(begins & self._columns(shape), self.random.integers(1, 4, (self.rows, 1)), 0)
        offset, scale = self.random.normal(0.0, 0.1, shape), self.random.uniform(0.0, 2.0, shape)
        about, before = (1.0 - scale) * self.joint_pos, np.where(is_over, 0.0, self.offset)
        self.scale = np.where(kind == 2, scale, np.where(is_over, 1.0, self.scale))
        self.offset = np.where(kind == 1, offset, np.where(kind == 2, about, before))
        self.is_frozen = (kind == 3) | (self.is_frozen & ~is_over)
        end = self.time + self.random.exponential(0.2, self.rows)
        self.until = np.where(begins[:, 0], end, self.until)
        truth = self.scale * self.joint_pos + self.offset
        self.measured = np.where(self.is_frozen, self.measured, truth)

    def _pose(self, spread: float) -> np.ndarray:
        """Return poses near the start pose; with a wide spread, some are beyond the limits."""
        pose = HOME + self.random.normal(0.0, spread, (self.rows, len(JOINTS)))
        return np.clip(pose, self.limits.joints.lower, self.limits.joints.upper) if spread < 1.0 else pose

    def _decide(self) -> None:
        """Choose targets: near the joints, anywhere, or from limit to limit."""
        kind = self.random.random((self.rows, 1))
        shape = self.target.shape
        near = self.joint_pos + self.random.normal(0.0, 0.2, shape)
        swing = np.where(self.random.random(shape) < 0.5, self.limits.joints.lower, self.limits.joints.upper)
        anywhere = self.random.uniform(-7.0, 7.0, shape)
        target = np.where(kind < 0.7, near, np.where(kind < 0.85, swing, anywhere))
        is_due = self.time - self.sent["target_stamp"] >= CONTROL_DT * self.random.random(self.rows)
        self.target = np.where(is_due[:, None], target, self.target)
        self._deliver("target_stamp", is_due)

    def _send(self) -> None:
        """Deliver messages, some out of order; some senders pause."""
        for name in SENDERS[:1] + SENDERS[2:]:
            self._deliver(name, self.random.random(self.rows) < 0.9)
        for name in SENDERS:
            silence = self._happens() * self.random.exponential(0.1, self.rows)
            self.silent_until[name] = np.maximum(self.silent_until[name], self.time + silence)

    def _deliver(self, name: str, is_due: np.ndarray) -> None:
        delay = self.random.exponential(0.001, self.rows)
        is_sent = is_due & (self.time > self.silent_until[name] + 1e-9)
        self.sent[name] = np.where(is_sent, self.time - delay, self.sent[name])

    def _requests(self) -> np.ndarray:
        """Return stamps of requests to arm, some in the past or future."""
        is_requested = self.random.random(self.rows) < 0.05
        stamp = self.time + self.random.normal(0.0, 0.05, self.rows) * self._happens()
        return self._wrong(np.where(is_requested, stamp, -np.inf), WRONG_STAMPS)

    def _happens(self) -> np.ndarray:
        return self.random.random(self.rows) < self.chance

    def _wrong(self, values: np.ndarray, strange: np.ndarray) -> np.ndarray:
        """Replace values in some rows, of one joint or of all."""
        is_wrong = self._happens()
        if values.ndim == 1:
            return np.where(is_wrong, self.random.choice(strange, self.rows), values)
        picked = self.random.choice(strange, (self.rows, 1))
        return np.where(is_wrong[:, None] & self._columns(values.shape), picked, values)

    def _columns(self, shape: tuple[int, ...]) -> np.ndarray:
        """Select all joints of a row, or one of them."""
        joint = self.random.integers(-1, shape[1], (self.rows, 1))
        return (np.arange(shape[1]) == joint) | (joint < 0)
