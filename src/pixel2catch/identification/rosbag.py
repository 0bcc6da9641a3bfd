"""Recordings of ROS 2: a bag with `/joint_states` and the topic on which the commands were sent."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from pixel2catch.errors import Pixel2CatchError, RecordingError
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.rules import Place, require_motion

MEASURED_TOPIC = "/joint_states"
"""Topic of the measurements. Source: ROS 2, `joint_state_broadcaster`."""

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


def read_rosbag(path: Path, joints: tuple[str, ...], command_topic: str | None = None) -> Recording:
    """Read the motion of some joints from a rosbag2 (MCAP or SQLite).

    A topic's times are its header stamps, or the bag's receive times if any header has none. Both are counted
    from the earlier of the two first times.

    Args:
        path: The bag's folder, or its .mcap or .db3 file.
        joints: Names of the joints; a message without names has these, in this order.
        command_topic: Topic of the commands; may be absent if only one topic can be it.

    Raises:
        RecordingError: If a topic or joint is missing, or a message says what cannot be.
    """
    with _opened(path) as reader:
        topic = command_topic or _only_command_topic(path, reader)
        command_ns, command = _read_topic(path, reader, topic, joints)
        measured_ns, measured = _read_topic(path, reader, MEASURED_TOPIC, joints)
    start = min(command_ns[0], measured_ns[0])
    return Recording(
        name=str(path),
        joints=joints,
        t_cmd=_seconds(command_ns - start),
        q_cmd=command["position"],
        t_meas=_seconds(measured_ns - start),
        q=measured["position"],
        qd=measured.get("velocity"),
        effort=measured.get("effort"),
    )


def _seconds(nanoseconds: np.ndarray) -> np.ndarray:
    return nanoseconds.astype(np.float64) / 1e9


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """The bag, closed afterwards; whatever a damaged one makes the library raise becomes one error."""
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except Pixel2CatchError:
        raise
    except Exception as error:
        raise RecordingError(f"{path}: not a readable rosbag2 ({error}); try 'ros2 bag reindex'.") from error


def _only_command_topic(path: Path, reader: AnyReader) -> str:
    """The one topic that can carry commands."""
    types = {connection.topic: connection.msgtype for connection in reader.connections}
    found = sorted(topic for topic, kind in types.items() if kind in PARSERS and topic != MEASURED_TOPIC)
    if len(found) != 1:
        raise RecordingError(
            f"{path}: {len(found)} topics could carry the commands ({', '.join(found) or 'none'}); "
            f"record one of type {', '.join(PARSERS)}, or name it with --command-topic."
        )
    return found[0]


def _read_topic(
    path: Path, reader: AnyReader, topic: str, joints: tuple[str, ...]
) -> tuple[np.ndarray, Fields]:
    """Times [ns] and fields of a topic, with columns in the order of `joints`."""
    place = Place(source=f"{path}, topic {topic}", row="message")
    connections = [connection for connection in reader.connections if connection.topic == topic]
    if not connections:
        names = ", ".join(sorted({connection.topic for connection in reader.connections}))
        raise RecordingError(f"{path}: no topic {topic}; recorded are: {names or 'none'}. Record it, too.")
    messages, received = [], []
    for connection, time, data in reader.messages(connections):
        where = place.at(len(messages))
        messages.append(
            _parser(where, connection.msgtype)(where, reader.deserialize(data, connection.msgtype))
        )
        received.append(time)
    if not messages:
        raise RecordingError(f"{place.source}: empty, there is no message; record again.")
    fields = _columns(place, messages, joints)
    stamps = [message.stamp for message in messages]
    times = np.array(stamps if all(stamps) else received, dtype=np.int64)
    require_motion(place, joints, _seconds(times - times[0]), *fields.values())
    return times, fields


def _columns(place: Place, messages: list[JointMessage], joints: tuple[str, ...]) -> Fields:
    """The fields that every message has; `position` comes first."""
    recorded = messages[0].joints or joints
    missing = [joint for joint in joints if joint not in recorded]
    if missing:
        raise RecordingError(
            f"{place.source}: no joint {', '.join(missing)}; it has {', '.join(recorded)}. "
            "Record the missing joints, rename them, or choose another --robot."
        )
    for i, message in enumerate(messages):
        _require_same_order(place.at(i), message, messages[0], len(recorded))
    order = [recorded.index(joint) for joint in joints]
    names = ["position", *(n for n in SPEED_AND_EFFORT if all(n in message.fields for message in messages))]
    return {name: np.stack([message.fields[name] for message in messages])[:, order] for name in names}


def _require_same_order(where: str, message: JointMessage, first: JointMessage, num_joints: int) -> None:
    if message.joints != first.joints:
        raise RecordingError(
            f"{where}: joints {', '.join(message.joints)}, but the first message has "
            f"{', '.join(first.joints)}; two publishers share the topic: record them on topics of their own."
        )
    for name, values in message.fields.items():
        if len(values) != num_joints:
            raise RecordingError(
                f"{where}: {len(values)} numbers in {name} for {num_joints} joints; "
                "publish one number a joint, or choose the --robot that has so many."
            )


def _parser(where: str, message_type: str) -> Callable[[str, Any], JointMessage]:
    """The function that reads a type of message."""
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
