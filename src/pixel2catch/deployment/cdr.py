"""Messages of ROS 2 as bytes (CDR) and back, by rosbags: what all types have in common."""

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pixel2catch.errors import DeploymentError

SAFETY_MODE = "ur_dashboard_msgs/msg/SafetyMode"
ROBOT_MODE = "ur_dashboard_msgs/msg/RobotMode"

STORE = get_typestore(Stores.ROS2_JAZZY)
"""Definitions of all messages. Source: ROS 2 Jazzy; the two modes: `ur_dashboard_msgs`."""

STORE.register(
    {**get_types_from_msg("uint8 mode", SAFETY_MODE), **get_types_from_msg("int8 mode", ROBOT_MODE)}
)


def encode(kind: str, *fields: Any) -> bytes:
    """The message of a type with these fields."""
    return bytes(STORE.serialize_cdr(STORE.types[kind](*fields), kind))


def decode(data: bytes, kind: str) -> Any:
    """The message as rosbags has it; its arrays are views of the data.

    Raises:
        DeploymentError: It is of another type, or damaged.
    """
    try:
        return STORE.deserialize_cdr(memoryview(data), kind)
    except (SerdeError, struct.error, ValueError, IndexError) as error:
        raise DeploymentError(
            f"a message is no {kind} ({error}): two programs disagree about the type of a topic."
        ) from error


def float64(values: Iterable[float]) -> np.ndarray:
    """An array as the codec wants it."""
    return np.array(values if isinstance(values, np.ndarray) else tuple(values), dtype=np.float64)


def header(stamp: float, frame_id: str = "") -> Any:
    """A header of a time since the epoch [s]."""
    nanoseconds = round(stamp * 1e9)
    time = STORE.types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def seconds(header: Any) -> float:
    """Time of a header since the epoch [s]."""
    return header.stamp.sec + 1e-9 * header.stamp.nanosec
