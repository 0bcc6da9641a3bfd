"""Recordings of ROS 2 (rosbag2: MCAP or SQLite), opened and read message by message. Needs rosbags."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixel2catch.errors import PerceptionError, Pixel2CatchError, RecordingError
from pixel2catch.installation import install_command

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

BAG_SUFFIXES = (".mcap", ".db3")


@contextmanager
def opened_bag(
    path: Path, error: type[Pixel2CatchError] = PerceptionError, extra: str = "perception"
) -> "Iterator[AnyReader]":
    """A bag, by its folder or .mcap or .db3 file; whatever a damaged one raises becomes one error.

    Raises:
        error: If it cannot be read, or the library is missing, which the package's `extra` brings along.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as missing:
        raise error(f"{path}: reading bags needs {missing.name}; {install_command(extra)}.") from None
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except Pixel2CatchError:
        raise
    except Exception as damage:
        raise error(f"{path}: not a readable rosbag2 ({damage}); try 'ros2 bag reindex'.") from damage


@dataclass(frozen=True, kw_only=True)
class BagMessage:
    """A message of a bag."""

    topic: str
    type: str  #: its ROS type
    received: int  #: when the recorder got it [ns]
    stamp: int  #: time in its header [ns]; 0 if there is none
    content: Any  #: as `messages.decode` has it


def decoded(reader: "AnyReader", connections: "list[Connection]") -> Iterator[BagMessage]:
    """The messages of some connections, in the order of the bag.

    Raises:
        DeploymentError: If one is damaged.
    """
    from pixel2catch.ros2.messages import decode, nanoseconds

    for connection, received, data in reader.messages(connections):
        content = decode(data, connection.msgtype)
        yield BagMessage(
            topic=connection.topic,
            type=connection.msgtype,
            received=received,
            stamp=nanoseconds(content.header) if hasattr(content, "header") else 0,
            content=content,
        )


MOTION_TYPES = (
    "sensor_msgs/msg/JointState",
    "trajectory_msgs/msg/JointTrajectory",
    "std_msgs/msg/Float64MultiArray",
)
"""Types of messages that have positions of joints."""

MOTION_FIELDS = ("position", "velocity", "effort")
"""What they say of a joint [rad, rad/s, N·m]; all but the first may be missing."""


@dataclass(frozen=True, kw_only=True)
class JointMotion:
    """What a message of one of `MOTION_TYPES` says."""

    joints: tuple[str, ...]  #: names in the order of the numbers; empty if the type has none
    fields: dict[str, np.ndarray]  #: one number a joint, by those of `MOTION_FIELDS` that were given


def joint_motion(where: str, message: BagMessage) -> JointMotion:
    """Read a joint state, a trajectory of one target, or numbers without names.

    Raises:
        RecordingError: If it is of another type, or has no target; the text begins with the place.
    """
    content = message.content
    if message.type == "std_msgs/msg/Float64MultiArray":
        joints, fields = (), {"position": content.data}
    elif message.type == "trajectory_msgs/msg/JointTrajectory":
        if len(content.points) != 1:
            raise RecordingError(
                f"{where}: a trajectory of {len(content.points)} points, which a controller interpolates; "
                "record the targets that are streamed to the joints, one point a message."
            )
        joints, fields = content.joint_names, {"position": content.points[0].positions}
    elif message.type == "sensor_msgs/msg/JointState":
        if not len(content.position):
            raise RecordingError(f"{where}: a joint state without positions; record one that has them.")
        given = {name: getattr(content, name) for name in MOTION_FIELDS}
        joints, fields = content.name, {name: values for name, values in given.items() if len(values)}
    else:
        raise RecordingError(f"{where}: type {message.type} is not read; record {', '.join(MOTION_TYPES)}.")
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in fields.items()}
    return JointMotion(joints=tuple(joints), fields=arrays)
