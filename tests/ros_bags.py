"""Messages of ROS 2 with times in nanoseconds, and bags of them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from pixel2catch.ros2.messages import STORE

TYPES: dict[str, Any] = STORE.types
EPOCH = 1_790_000_000
Message = tuple[str, int, Any]
"""Topic, time of reception [ns], message."""


def header(stamp: int) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=time, frame_id="")


def joint_state(stamp: int, names: Iterable[str], positions: Iterable[float]) -> Any:
    numbers = (np.array(list(values), dtype=np.float64) for values in (positions, (), ()))
    return TYPES["sensor_msgs/msg/JointState"](header(stamp), list(names), *numbers)


def save_bag(
    path: Path,
    messages: Iterable[Message],
    storage: StoragePlugin = StoragePlugin.MCAP,
    mode: CompressionMode = CompressionMode.NONE,
) -> Path:
    bag = Writer(path, version=9, storage_plugin=storage)
    bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        connections = {}
        for topic, received, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            bag.write(connections[topic], received, STORE.serialize_cdr(message, message.__msgtype__))
    return path
