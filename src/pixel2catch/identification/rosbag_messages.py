"""The messages of ROS 2 that carry positions of joints, as one kind of value."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixel2catch.errors import RecordingError

SPEED_AND_EFFORT = ("velocity", "effort")
"""Fields of a joint state that may be empty."""

Fields = dict[str, np.ndarray]
"""Numbers of one message by field, one a joint."""


@dataclass(frozen=True, kw_only=True)
class JointMessage:
    """What a message of any of the types says.

    Attributes:
        joints: Names in the order of the numbers; empty if the type has none.
        fields: `position` [rad], and `velocity` [rad/s] and `effort` [N·m] where given.
        stamp: Time in its header [ns], 0 if there is none.
    """

    joints: tuple[str, ...]
    fields: Fields
    stamp: int = 0


def parser(where: str, message_type: str) -> Callable[[str, Any], JointMessage]:
    """The function that reads a type of message; it gets the message's place and the message.

    Args:
        where: The place of the message, for the error.
        message_type: Its type.

    Raises:
        RecordingError: If the type is not read.
    """
    if message_type not in PARSERS:
        raise RecordingError(f"{where}: type {message_type} is not read; record {', '.join(PARSERS)}.")
    return PARSERS[message_type]


def _joint_state(where: str, message: Any) -> JointMessage:
    """A `sensor_msgs/JointState`."""
    if not len(message.position):
        raise RecordingError(f"{where}: a joint state without positions; record one that has them.")
    optional = {name: np.asarray(getattr(message, name), dtype=np.float64) for name in SPEED_AND_EFFORT}
    fields = {"position": np.asarray(message.position, dtype=np.float64)}
    fields |= {name: values for name, values in optional.items() if len(values)}
    return JointMessage(joints=tuple(message.name), fields=fields, stamp=_stamp(message.header))


def _trajectory(where: str, message: Any) -> JointMessage:
    """A `trajectory_msgs/JointTrajectory` that carries one target, as streamed commands do."""
    if len(message.points) != 1:
        raise RecordingError(
            f"{where}: a trajectory of {len(message.points)} points, which a controller interpolates; "
            "record the targets that are streamed to the joints, one point a message."
        )
    fields = {"position": np.asarray(message.points[0].positions, dtype=np.float64)}
    return JointMessage(joints=tuple(message.joint_names), fields=fields, stamp=_stamp(message.header))


def _array(where: str, message: Any) -> JointMessage:
    """A `std_msgs/Float64MultiArray`: numbers without names and without a time."""
    del where
    return JointMessage(joints=(), fields={"position": np.asarray(message.data, dtype=np.float64)})


def _stamp(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


PARSERS: dict[str, Callable[[str, Any], JointMessage]] = {
    "sensor_msgs/msg/JointState": _joint_state,
    "trajectory_msgs/msg/JointTrajectory": _trajectory,
    "std_msgs/msg/Float64MultiArray": _array,
}
"""How each type of message is read."""
