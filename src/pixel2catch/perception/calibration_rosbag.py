"""The CameraInfo of a ROS 2 bag. Needs rosbags."""

from pathlib import Path
from typing import Any

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.rosbag_images import opened_bag

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


def first_camera_info(path: Path, topic: str | None) -> Any:
    """Return the first CameraInfo of a topic.

    Args:
        path: The bag's folder, or its .mcap or .db3 file.
        topic: The topic; None for the only one.

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
