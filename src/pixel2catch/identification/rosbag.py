"""Recordings of ROS 2: a bag with the joint states and the topics on which the commands were sent."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from pixel2catch.errors import Pixel2CatchError, RecordingError
from pixel2catch.identification.names import CommandTopic, Names
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.rosbag_messages import PARSERS, SPEED_AND_EFFORT, Fields, JointMessage, parser
from pixel2catch.identification.rules import Place, require_motion

REMEDY = "Record the missing joints, rename them (--rename OURS=THEIRS), or choose another --robot."
"""What to do about joints that are not there."""


@dataclass(frozen=True, kw_only=True)
class Stream:
    """The motion on one topic.

    Attributes:
        joints: Those of the wanted joints that it has, the columns.
        recorded: All joints that it has, for messages.
        times: When each message was sent [ns].
        fields: `position` [rad], and `velocity` [rad/s] and `effort` [N·m] where every message has them.
    """

    joints: tuple[str, ...]
    recorded: tuple[str, ...]
    times: np.ndarray
    fields: Fields


@dataclass(frozen=True, kw_only=True)
class _Bag:
    """An open bag, and what is looked for in it."""

    path: Path
    reader: AnyReader
    joints: tuple[str, ...]
    names: Names


def read_rosbag(path: Path, joints: tuple[str, ...], names: Names) -> Recording:
    """Read the motion of some joints from a rosbag2 (MCAP or SQLite).

    A topic's times are its header stamps, or the bag's receive times if any header has none. All are counted
    from the earliest. Several topics of commands become one stream, with a row whenever one of them changes.

    Args:
        path: The bag's folder, or its .mcap or .db3 file.
        joints: Names of the joints; a message without names has these, in this order, unless `names` tells.
        names: What the bag calls topics and joints.

    Raises:
        RecordingError: If a topic or joint is missing, or a message says what cannot be.
    """
    with _opened(path) as reader:
        bag = _Bag(path=path, reader=reader, joints=joints, names=names)
        topics = names.command_topics or (CommandTopic(name=_only_command_topic(bag)),)
        command_ns, q_cmd = _merged(bag, topics)
        measured = _read_topic(bag, CommandTopic(name=names.measured_topic))
    _require_all(f"{path}, topic {names.measured_topic}", joints, [measured])
    start = min(command_ns[0], measured.times[0])
    return Recording(
        name=str(path),
        joints=joints,
        t_cmd=_seconds(command_ns - start),
        q_cmd=q_cmd,
        t_meas=_seconds(measured.times - start),
        q=measured.fields["position"],
        qd=measured.fields.get("velocity"),
        effort=measured.fields.get("effort"),
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


def _only_command_topic(bag: _Bag) -> str:
    """The one topic that can carry commands."""
    types = {connection.topic: connection.msgtype for connection in bag.reader.connections}
    measured = bag.names.measured_topic
    found = sorted(topic for topic, kind in types.items() if kind in PARSERS and topic != measured)
    if len(found) != 1:
        raise RecordingError(
            f"{bag.path}: {len(found)} topics could carry the commands ({', '.join(found) or 'none'}); "
            f"record one of type {', '.join(PARSERS)}, or name those that do with --command-topic."
        )
    return found[0]


def _merged(bag: _Bag, topics: Sequence[CommandTopic]) -> tuple[np.ndarray, np.ndarray]:
    """Times [ns] and positions [rad] of the commands on all topics together.

    There is a row for each time at which a command was sent; what was not sent then holds, the first also
    before it was sent.
    """
    streams = [_read_topic(bag, topic) for topic in topics]
    source = f"{bag.path}, topic {', '.join(topic.name for topic in topics)}"
    _require_all(source, bag.joints, streams)
    times = streams[0].times
    for stream in streams[1:]:
        times = np.sort(np.concatenate((times, stream.times[~np.isin(stream.times, times)])))
    columns = {}
    for stream in streams:
        row = np.maximum(np.searchsorted(stream.times, times, side="right") - 1, 0)
        columns |= dict(zip(stream.joints, stream.fields["position"][row].T, strict=True))
    return times, np.stack([columns[joint] for joint in bag.joints], axis=-1)


def _require_all(source: str, joints: tuple[str, ...], streams: Sequence[Stream]) -> None:
    """Refuse streams that lack a joint, or that have one twice."""
    found = [joint for stream in streams for joint in stream.joints]
    missing = [joint for joint in joints if joint not in found]
    if missing:
        recorded = ", ".join(name for stream in streams for name in stream.recorded)
        raise RecordingError(f"{source}: no joint {', '.join(missing)}; it has {recorded}. {REMEDY}")
    twice = sorted({joint for joint in found if found.count(joint) > 1})
    if twice:
        raise RecordingError(
            f"{source}: {', '.join(twice)} on more than one topic; give every joint one --command-topic, "
            "TOPIC=JOINT,JOINT where the messages name none."
        )


def _read_topic(bag: _Bag, topic: CommandTopic) -> Stream:
    """The motion of those of the joints that a topic has."""
    place = Place(source=f"{bag.path}, topic {topic.name}", row="message")
    everything = _messages(bag, place, topic.name)
    concerned = [pair for pair in everything if not pair[1].joints or {*pair[1].joints} & {*bag.joints}]
    if 0 < len(concerned) < len(everything):
        everything, place = concerned, replace(place, row="message of these joints")
    received, messages = zip(*everything, strict=True)
    if messages[0].joints and topic.joints:
        raise RecordingError(
            f"{place.source}: its messages name the joints {', '.join(messages[0].joints)}; "
            f"leave out '=...' behind --command-topic {topic.name}."
        )
    recorded = messages[0].joints or topic.joints or bag.joints
    joints = tuple(joint for joint in bag.joints if joint in recorded)
    fields = _columns(place, messages, recorded, joints)
    stamps = [message.stamp for message in messages]
    times = np.array(stamps if all(stamps) else received, dtype=np.int64)
    require_motion(place, joints, _seconds(times - times[0]), *fields.values())
    return Stream(joints=joints, recorded=recorded, times=times, fields=fields)


def _messages(bag: _Bag, place: Place, topic: str) -> list[tuple[int, JointMessage]]:
    """Receive time [ns] and content of every message on a topic, with our names of the joints."""
    connections = [connection for connection in bag.reader.connections if connection.topic == topic]
    if not connections:
        names = ", ".join(sorted({connection.topic for connection in bag.reader.connections}))
        raise RecordingError(
            f"{bag.path}: no topic {topic}; recorded are: {names or 'none'}. Record it, too."
        )
    messages = []
    for connection, time, data in bag.reader.messages(connections):
        where = place.at(len(messages))
        message = parser(where, connection.msgtype)(where, bag.reader.deserialize(data, connection.msgtype))
        messages.append((time, replace(message, joints=bag.names.ours(message.joints))))
    if not messages:
        raise RecordingError(f"{place.source}: empty, there is no message; record again.")
    return messages


def _columns(
    place: Place, messages: Sequence[JointMessage], recorded: tuple[str, ...], joints: tuple[str, ...]
) -> Fields:
    """The fields that every message has, in the columns of some joints; `position` comes first."""
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
                f"{where}: {len(values)} numbers in {name} for {num_joints} joints; publish one number a "
                "joint, choose the --robot that has so many, or say which: --command-topic TOPIC=JOINT,..."
            )
