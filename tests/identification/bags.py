"""Messages of ROS 2 and bags of them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from recorded import ARM
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pixel2catch.identification.recording import Recording

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES: dict[str, Any] = STORE.types
JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
EPOCH_NS = 1_790_000_000 * 10**9
NANOSECOND = 1e-9
SHUFFLED = [2, 1, 0, 3, 4, 5]
"""UR's driver publishes the elbow first."""

Message = tuple[str, int, Any]
"""Topic, time [ns], message."""


def header(time: int) -> Any:
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id="")


def nanoseconds(time: float) -> int:
    return EPOCH_NS + round(time * 1e9)


def joint_state(time: int, names: Iterable[str], position) -> Any:
    numbers = (np.array(values, dtype=np.float64) for values in (position, (), ()))
    return TYPES[JOINT_STATE](header(time), list(names), *numbers)


def trajectory(time: int, names: Iterable[str], *points: np.ndarray) -> Any:
    duration, empty = TYPES["builtin_interfaces/msg/Duration"](sec=0, nanosec=0), np.zeros(0)
    point_type = TYPES["trajectory_msgs/msg/JointTrajectoryPoint"]
    targets = [point_type(np.array(point), empty, empty, empty, duration) for point in points]
    return TYPES[TRAJECTORY](header(time), list(names), targets)


def array(values: np.ndarray) -> Any:
    return TYPES[ARRAY](TYPES["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0), np.array(values))


def measured(recording: Recording, order: list[int] = SHUFFLED) -> list[Message]:
    """Joint states whose receive time is 3 ms behind their stamp, with a joint that nobody asks for."""
    messages, names = [], [*(ARM[i] for i in order), "gripper_joint"]
    for time, positions in zip(recording.t_meas, recording.q, strict=True):
        stamp = nanoseconds(time)
        state = joint_state(stamp, names, [*positions[order], 99.0])
        messages.append(("/joint_states", stamp + 3_000_000, state))
    return messages


def commands(recording: Recording, kind: str) -> list[Message]:
    """The commands as messages of a type; an array has only the time at which it was received."""
    messages = []
    for time, position in zip(recording.t_cmd, recording.q_cmd, strict=True):
        stamp = nanoseconds(time)
        message = {
            JOINT_STATE: lambda s=stamp, p=position: joint_state(s, ARM, p),
            TRAJECTORY: lambda s=stamp, p=position: trajectory(s, ARM, p),
            ARRAY: lambda p=position: array(p),
        }[kind]()
        messages.append(("/command", stamp + (0 if kind == ARRAY else 5_000_000), message))
    return messages


def write_bag(path: Path, messages: list[Message], storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with Writer(path, version=9, storage_plugin=storage) as bag:
        connections = {}
        for topic, time, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            data = STORE.serialize_cdr(message, message.__msgtype__)
            bag.write(connections[topic], time, data)
    return path
