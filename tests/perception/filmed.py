"""The painted throw as files: a video, a bag of ROS 2, and the camera that took it."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from painted import HEIGHT, WIDTH, Disc, images, thrown
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.image import Pixels
from pixel2catch.files import json_text
from pixel2catch.perception.labels import FORMAT_VERSION, Labels
from pixel2catch.rendering.video import VideoWriter
from pixel2catch.scene.constants import RGB_CAMERA

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES: dict[str, Any] = STORE.types
EPOCH = 1_790_000_000
PERIOD_NS = 33_333_333

NUM_STILL, NUM_FLYING = 5, 15
PATH = thrown(NUM_STILL, NUM_FLYING)
DISC = Disc(path=PATH, radius=7)
HELD = 41
"""An image in which the object is held still."""

CAMERA = replace(RGB_CAMERA, width=WIDTH, height=HEIGHT, cx=WIDTH / 2, cy=HEIGHT / 2)
"""A camera of the size of the painted images: a quarter of the pixels, a quarter of the time."""

Message = tuple[str, int, Any]
"""Topic, time of reception [ns], message."""


def save_labels(path: Path, labels: Labels) -> None:
    """Write a label file of this package's own format."""
    path.write_text(json_text({"format_version": FORMAT_VERSION, **asdict(labels)}))


def throw() -> Iterator[Pixels]:
    """The throw, image by image."""
    return images((DISC,), len(PATH))


def box_at(step: int, margin: float = 1.0) -> list[str]:
    """The object's box, as words of a command."""
    (u, v), reach = PATH[step], DISC.radius + margin
    return [f"{edge:g}" for edge in (u - reach, v - reach, u + reach, v + reach)]


def save_video(path: Path, pictures: Iterable[Pixels], fps: int = 30) -> Path:
    with VideoWriter(path, fps=fps, crf=12) as video:
        for picture in pictures:
            video.write(picture)
    return path


def save_camera(path: Path) -> Path:
    CameraFile(camera=CAMERA).save(path)
    return path


def header(stamp: int) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=time, frame_id="camera")


def stamp_of(step: int) -> int:
    """When an image was taken [ns]."""
    return EPOCH * 10**9 + step * PERIOD_NS


def raw(step: int, pixels: np.ndarray, encoding: str = "rgb8", padding: int = 0) -> Message:
    """A `sensor_msgs/Image`, received 20 ms after it was taken, with unused bytes at the end of each row."""
    height, width, channels = pixels.shape
    rows = np.zeros((height, channels * width + padding), dtype=np.uint8)
    rows[:, : channels * width] = pixels.reshape(height, -1)
    size = {"height": height, "width": width, "step": rows.shape[1], "is_bigendian": 0}
    stamp = stamp_of(step)
    message = TYPES["sensor_msgs/msg/Image"](
        header=header(stamp), encoding=encoding, data=rows.reshape(-1), **size
    )
    return "/camera/image_raw", stamp + 20_000_000, message


def compressed(step: int, data: bytes, kind: str = "rgb8; jpeg compressed bgr8") -> Message:
    """A `sensor_msgs/CompressedImage`."""
    stamp = stamp_of(step)
    message = TYPES["sensor_msgs/msg/CompressedImage"](
        header=header(stamp), format=kind, data=np.frombuffer(data, dtype=np.uint8)
    )
    return "/camera/image_raw/compressed", stamp + 20_000_000, message


def jpeg(image: Pixels) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def joint_state(stamp: int, names: Iterable[str], positions: np.ndarray) -> Message:
    empty = np.zeros(0)
    message = TYPES["sensor_msgs/msg/JointState"](header(stamp), list(names), positions, empty, empty)
    return "/joint_states", stamp + 1_000_000, message


def save_bag(path: Path, messages: Iterable[Message], storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with Writer(path, version=9, storage_plugin=storage) as bag:
        connections = {}
        for topic, received, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            bag.write(connections[topic], received, STORE.serialize_cdr(message, message.__msgtype__))
    return path
