"""Images of a ROS 2 bag, with the joint positions and camera information that it recorded. Needs rosbags."""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixel2catch.camera.image import Image, Pixels
from pixel2catch.errors import PerceptionError
from pixel2catch.ros2.bags import BagMessage, decoded, opened_bag
from pixel2catch.ros2.messages import (
    CAMERA_INFO,
    CHANNELS,
    COMPRESSED_IMAGE,
    IMAGE,
    JOINT_STATE,
    pixels_of,
    unpacked_image,
)

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

IMAGE_TYPES = (IMAGE, COMPRESSED_IMAGE)
JOINT_STATES = "/joint_states"  #: Topic of the joint states of all robots.
NUM_STATES = 1000  #: Joint states that are kept until an image of their time arrives: 2 s at 500 Hz.


def first_camera_info(path: Path, topic: str | None) -> Any:
    """Return the first CameraInfo of a topic; None for the only topic.

    Raises:
        PerceptionError: The bag cannot be read, or has no such topic.
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
        return next(decoded(reader, [each for each in infos if each.topic == chosen[0]])).content


def bag_images(path: Path, topic: str | None, joints: Sequence[str], notes: list[str]) -> Iterator[Image]:
    """Yield the images of a topic, with the joint positions of their time.

    The stamp is that of the header, or the time of recording without one. Damaged images are left out, with
    a note.

    Args:
        path: The bag.
        topic: Of the images; None for the only one.
        joints: Names in `JOINT_STATES`, in joint order. Images have no positions if it is empty, or before
            the first position of every joint.
        notes: Get the number of damaged images.

    Raises:
        PerceptionError: The bag cannot be read, has no such topic, or images of another encoding.
    """
    with opened_bag(path) as reader:
        images = _image_connections(path, reader.connections, topic)
        wanted = (JOINT_STATES, JOINT_STATE)
        states = [each for each in reader.connections if (each.topic, each.msgtype) == wanted]
        positions, num_damaged, reason = _JointPositions(joints), 0, ""
        for message in decoded(reader, [*images, *states]):
            stamp = (message.stamp or message.received) / 1e9
            if message.type == JOINT_STATE:
                positions.add(message.content, stamp)
                continue
            pixels = _pixels(message)
            if pixels is None:
                num_damaged += 1
                reason = f"of {len(message.content.data)} bytes at {stamp:.3f} s"
                continue
            yield Image(pixels=pixels, stamp=stamp, joint_pos=positions.at(stamp))
        if num_damaged:
            notes.append(f"damaged images, passed over: {num_damaged}; the last {reason}.")


def _image_connections(path: Path, connections: "list[Connection]", topic: str | None) -> "list[Connection]":
    """The connections of the chosen topic, or of the only one with images."""
    images = [each for each in connections if each.msgtype in IMAGE_TYPES and each.msgcount]
    topics = sorted({connection.topic for connection in images})
    if topic is None and len(topics) == 1:
        return images
    chosen = [connection for connection in images if connection.topic == topic]
    if chosen:
        return chosen
    if not topics:
        raise PerceptionError(
            f"{path}: no topic has images ({', '.join(IMAGE_TYPES)}); record the camera, too."
        )
    wanted = "several topics have images" if topic is None else f"no images on a topic {topic}"
    raise PerceptionError(f"{path}: {wanted}; choose with --topic out of: {', '.join(topics)}.")


class _JointPositions:
    """Joint positions of the last seconds."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = joints
        self._known: dict[str, float] = {}
        self._stamps: deque[float] = deque(maxlen=NUM_STATES)
        self._positions: deque[np.ndarray] = deque(maxlen=NUM_STATES)

    def add(self, message: Any, stamp: float) -> None:
        """Add a joint state, which may have some of the joints only."""
        self._known.update(zip(message.name, message.position, strict=False))
        if self._joints and all(name in self._known for name in self._joints):
            self._stamps.append(stamp)
            self._positions.append(np.array([self._known[name] for name in self._joints]))

    def at(self, stamp: float) -> np.ndarray | None:
        """Return the last positions up to a time [rad]; None if there are none."""
        index = bisect_right(self._stamps, stamp) - 1
        return self._positions[index] if index >= 0 else None


def _pixels(message: BagMessage) -> Pixels | None:
    """The pixels of a message; None if it is damaged."""
    content = message.content
    if message.type == COMPRESSED_IMAGE:
        name = content.format.lower()
        if not any(known in name for known in ("jpeg", "jpg", "png")) or "depth" in name:
            raise PerceptionError(
                f"topic {message.topic}: format '{content.format}' is not read; record jpeg or png."
            )
        return unpacked_image(bytes(content.data))
    if content.encoding not in CHANNELS:
        raise PerceptionError(
            f"topic {message.topic}: encoding '{content.encoding}' is not read; record "
            f"{' or '.join(CHANNELS)}: the segmenters need colour, as an image of 8 bits a channel."
        )
    return pixels_of(content)
