"""Faults as changes of good inputs."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from paper_robot import JOINTS
from pixel2catch.servo.link import Fault
from pixel2catch.servo.state import ServoInputs

ELBOW = np.arange(len(JOINTS)) == 2


def aged(seconds: float) -> Callable[[ServoInputs], np.ndarray]:
    """Return an older stamp."""
    return lambda good: good.now - seconds


def elbow(value: float, field: str) -> Callable[[ServoInputs], np.ndarray]:
    """Return a value for the elbow only."""
    return lambda good: np.where(ELBOW, value, getattr(good, field))


def finger(value: float) -> Callable[[ServoInputs], np.ndarray]:
    """Return a position for one finger joint."""
    return lambda good: np.where(np.arange(len(JOINTS)) == 8, value, good.joint_pos)


def always(value: float | bool) -> Callable[[ServoInputs], np.ndarray]:
    """One value in every row."""
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
