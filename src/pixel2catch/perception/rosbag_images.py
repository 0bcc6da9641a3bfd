"""Images of a ROS 2 bag, with the joint positions and camera information that it recorded. Needs rosbags."""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from pixel2catch.errors import PerceptionError, Pixel2CatchError
from pixel2catch.perception.extractor import CameraFrame
from pixel2catch.perception.segmenter import Image

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

CHANNEL_ORDERS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0)}
"""Encodings that are read, and where red, green and blue are in them."""

JOINT_STATE, CAMERA_INFO = "sensor_msgs/msg/JointState", "sensor_msgs/msg/CameraInfo"

NUM_STATES = 1000
"""Joint states that are remembered until an image of their time arrives: 2 s at 500 Hz."""


@contextmanager
def opened_bag(path: Path) -> "Iterator[AnyReader]":
    """A bag, by its folder or .mcap or .db3 file; whatever a damaged one raises becomes one error.

    Raises:
        PerceptionError: If it cannot be read, or the library is missing.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise PerceptionError(
            f"{path}: reading bags needs {error.name}: pip install 'pixel2catch[perception]'."
        ) from None
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except Pixel2CatchError:
        raise
    except Exception as error:
        raise PerceptionError(f"{path}: not a readable rosbag2 ({error}); try 'ros2 bag reindex'.") from error


def first_camera_info(path: Path, topic: str | None) -> Any:
    """Return the first CameraInfo of a topic; None for the only topic.

    Raises:
        PerceptionError: If the bag cannot be read, or has no such topic.
    """
    with opened_bag(path) as reader:
        infos = [each for each in reader.connections if each.msgtype == CAMERA_INFO and each.msgcount]
        topics = sorted({each.topic for each in infos})
        chosen = topics if topic is None else [topic]
        if len(chosen) != 1 or chosen[0] not in topics:
            raise PerceptionError(
                f"{path}: CameraInfo is on {', '.join(topics) or 'no topic'}; record the camera's "
                "camera_info, and choose one with --topic."
            )
        messages = reader.messages([each for each in infos if each.topic == chosen[0]])
        connection, _, data = next(messages)
        return reader.deserialize(data, connection.msgtype)


def bag_frames(
    path: Path, topic: str | None, joint_states: str, joints: Sequence[str], notes: list[str]
) -> Iterator[CameraFrame]:
    """Yield the images of a topic, with the joint positions of their time if all joints were recorded.

    The stamp is that of the header, or the time of recording where it has none.

    Args:
        path: The bag's folder, or its .mcap or .db3 file.
        topic: The topic of the images; None for the only one.
        joint_states: The topic of the joint states; it may be missing.
        joints: Names of the joints, in joint order; none if no positions are asked for.
        notes: Gets how many images could not be decoded, and why.

    Raises:
        PerceptionError: If the bag cannot be read, has no such topic, or images of another encoding.
    """
    with opened_bag(path) as reader:
        images = _image_connections(path, reader.connections, topic)
        states = [
            each for each in reader.connections if each.topic == joint_states and each.msgtype == JOINT_STATE
        ]
        positions, num_damaged, reason = _JointPositions(joints), 0, ""
        for connection, time, data in reader.messages([*images, *states]):
            message: Any = reader.deserialize(data, connection.msgtype)
            stamp = _stamp(message.header, time)
            if connection in states:
                positions.learn(message, stamp)
                continue
            image = DECODERS[connection.msgtype](f"topic {connection.topic}", message)
            if image is None:
                num_damaged, reason = num_damaged + 1, f"of {len(message.data)} bytes at {stamp:.3f} s"
                continue
            yield CameraFrame(image=image, stamp=stamp, joint_pos=positions.at(stamp))
        if num_damaged:
            notes.append(f"damaged images, passed over: {num_damaged}; the last {reason}.")


def _image_connections(path: Path, connections: "list[Connection]", topic: str | None) -> "list[Connection]":
    """The connections of the chosen topic, or of the only one with images."""
    images = [each for each in connections if each.msgtype in DECODERS and each.msgcount]
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


class _JointPositions:
    """Where the joints were in the last seconds."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = joints
        self._known: dict[str, float] = {}
        self._stamps: deque[float] = deque(maxlen=NUM_STATES)
        self._positions: deque[np.ndarray] = deque(maxlen=NUM_STATES)

    def learn(self, message: Any, stamp: float) -> None:
        """Take over a joint state, which may have some of the joints only."""
        self._known.update(zip(message.name, message.position, strict=False))
        if self._joints and all(name in self._known for name in self._joints):
            self._stamps.append(stamp)
            self._positions.append(np.array([self._known[name] for name in self._joints]))

    def at(self, stamp: float) -> np.ndarray | None:
        """The last positions before a time [rad]; None if there are none."""
        index = bisect_right(self._stamps, stamp) - 1
        return self._positions[index] if index >= 0 else None


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
