"""Images of a ROS 2 bag, with the robot's joint positions where it recorded them. Needs rosbags."""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from pixel2catch.errors import PerceptionError, Pixel2CatchError
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.perception.segmenter import Image
from pixel2catch.robot.constants import JOINTS

CHANNEL_ORDERS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0)}
"""Encodings that are read, and where red, green and blue are in them."""

JOINT_STATE = "sensor_msgs/msg/JointState"

NUM_STATES = 1000
"""Joint states that are remembered until an image of their time arrives: 2 s at 500 Hz."""


def bag_frames(path: Path, topic: str | None, joint_states: str, notes: list[str]) -> Iterator[CameraFrame]:
    """Yield the images of a topic, with the joint positions of their time if all joints were recorded.

    The stamp is that of the header, or the time of recording where it has none.

    Args:
        path: The bag's folder, or its .mcap or .db3 file.
        topic: The topic of the images; None for the only one.
        joint_states: The topic of the joint states; it may be missing.
        notes: Gets how many images could not be decoded, and why.

    Raises:
        PerceptionError: If the bag cannot be read, has no such topic, or images of another encoding.
    """
    with opened_bag(path) as reader:
        chosen = _image_connections(path, reader.connections, topic)
        states = [each for each in reader.connections if _is_joint_state(each, joint_states)]
        yield from _frames(reader, chosen, states, notes)


@contextmanager
def opened_bag(path: Path) -> Iterator[AnyReader]:
    """The bag, closed afterwards; whatever a damaged one makes the library raise becomes one error.

    Args:
        path: The bag's folder, or its .mcap or .db3 file.

    Raises:
        PerceptionError: If it cannot be read.
    """
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except Pixel2CatchError:
        raise
    except Exception as error:
        raise PerceptionError(f"{path}: not a readable rosbag2 ({error}); try 'ros2 bag reindex'.") from error


def _image_connections(path: Path, connections: list[Connection], topic: str | None) -> list[Connection]:
    """The connections of the chosen topic, or of the only one with images."""
    images = [
        connection for connection in connections if connection.msgtype in DECODERS and connection.msgcount
    ]
    topics = sorted({connection.topic for connection in images})
    if topic is None and len(topics) == 1:
        return images
    chosen = [connection for connection in images if connection.topic == topic]
    if chosen:
        return chosen
    if not topics:
        raise PerceptionError(f"{path}: no topic has images ({', '.join(DECODERS)}); record the camera, too.")
    wanted = "several topics have images" if topic is None else f"no images on a topic {topic}"
    raise PerceptionError(f"{path}: {wanted}; choose with --topic out of: {', '.join(topics)}.")


def _is_joint_state(connection: Connection, topic: str) -> bool:
    return connection.topic == topic and connection.msgtype == JOINT_STATE


def _frames(
    reader: AnyReader, images: list[Connection], states: list[Connection], notes: list[str]
) -> Iterator[CameraFrame]:
    """The images, in the order of the bag."""
    robot, num_damaged, reason = _Robot(), 0, ""
    for connection, time, data in reader.messages([*images, *states]):
        message: Any = reader.deserialize(data, connection.msgtype)
        if connection in states:
            robot.learn(message, time)
            continue
        stamp = _stamp(message.header, time)
        image = DECODERS[connection.msgtype](f"topic {connection.topic}", message)
        if image is None:
            num_damaged, reason = num_damaged + 1, f"of {len(message.data)} bytes at {stamp:.3f} s"
            continue
        yield CameraFrame(image=image, stamp=stamp, joint_pos=robot.at(stamp))
    if num_damaged:
        notes.append(f"damaged images, passed over: {num_damaged}; the last {reason}.")


@dataclass
class _Robot:
    """Where the joints were in the last seconds."""

    known: dict[str, float] = field(default_factory=dict)
    stamps: deque[float] = field(default_factory=lambda: deque(maxlen=NUM_STATES))
    positions: deque[np.ndarray] = field(default_factory=lambda: deque(maxlen=NUM_STATES))

    def learn(self, message: Any, time: int) -> None:
        """Take over a joint state, which may have some of the joints only."""
        self.known.update(zip(message.name, message.position, strict=False))
        if all(joint.name in self.known for joint in JOINTS):
            self.stamps.append(_stamp(message.header, time))
            self.positions.append(np.array([self.known[joint.name] for joint in JOINTS]))

    def at(self, stamp: float) -> np.ndarray | None:
        """The last positions before a time [rad]; None if there are none."""
        index = bisect_right(self.stamps, stamp) - 1
        return self.positions[index] if index >= 0 else None


def _stamp(header: Any, received: int) -> float:
    """Time of a header, or at which the message was received [s]."""
    nanoseconds = header.stamp.sec * 10**9 + header.stamp.nanosec
    return (nanoseconds or received) / 1e9


def _raw(where: str, message: Any) -> Image | None:
    """A `sensor_msgs/Image`; None if bytes are missing."""
    if message.encoding not in CHANNEL_ORDERS:
        raise PerceptionError(
            f"{where}: encoding '{message.encoding}' is not read; record {' or '.join(CHANNEL_ORDERS)}: the "
            "segmenters need colour, as an image of 8 bits a channel."
        )
    height, width, step = message.height, message.width, message.step
    if len(message.data) < height * step or step < 3 * width:
        return None
    rows = np.asarray(message.data)[: height * step].reshape(height, step)
    pixels = rows[:, : 3 * width].reshape(height, width, 3)
    return np.ascontiguousarray(pixels[..., CHANNEL_ORDERS[message.encoding]])


def _compressed(where: str, message: Any) -> Image | None:
    """A `sensor_msgs/CompressedImage` (JPEG or PNG); None if it is damaged."""
    kind = message.format.lower()
    if not any(known in kind for known in ("jpeg", "jpg", "png")) or "depth" in kind:
        raise PerceptionError(f"{where}: format '{message.format}' is not read; record jpeg or png.")
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


DECODERS: dict[str, Callable[[str, Any], Image | None]] = {
    "sensor_msgs/msg/Image": _raw,
    "sensor_msgs/msg/CompressedImage": _compressed,
}
"""How each type of message with an image is read."""
