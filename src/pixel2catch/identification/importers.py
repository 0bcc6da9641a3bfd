"""Reading a recording, whatever wrote it: our npz files, logs of RTDE, bags of ROS 2."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pixel2catch.errors import InvalidValueError, RecordingError, UnknownNameError
from pixel2catch.identification.joints import find_part, joints_of, specs_of
from pixel2catch.identification.recording import REMEDY, Place, Recording, held, require_motion
from pixel2catch.identification.tables import COMMAND_FILE, MEASURED_FILE, MOST_NAMED, read_rtde
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.ros2.bags import (
    METADATA,
    MOTION_FIELDS,
    MOTION_TYPES,
    BagMessage,
    JointMotion,
    decoded,
    is_bag,
    joint_motion,
    opened_bag,
)
from pixel2catch.ros2.profile import Profile
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

MEASURED_TOPIC = "/joint_states"  # topic of the measurements. Source: ROS 2, `joint_state_broadcaster`.

FORMATS = (
    f"an .npz file in the canonical layout, a folder with {MEASURED_FILE} and {COMMAND_FILE}, "
    "or a rosbag2: its folder, .mcap or .db3 file"
)
"""What can be read, in words."""


@dataclass(frozen=True, kw_only=True)
class CommandTopic:
    """A topic on which commands were sent."""

    name: str
    #: our names of the joints in messages that name none, in their order; empty if they are the robot's
    #: joints, or if the messages name them
    joints: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Names:
    """What a lab's recordings call our topics and joints."""

    command_topics: tuple[CommandTopic, ...] = ()  #: those of a bag; empty if only one can be it
    measured_topic: str = MEASURED_TOPIC  #: topic of the measurements of a bag
    #: the recording's names of joints that have another name there, by ours
    theirs: Mapping[str, str] = field(default_factory=dict)

    def ours(self, names: Iterable[str]) -> tuple[str, ...]:
        """Our names of recorded joints; one that is not ours is kept, but is never mistaken for ours."""
        renamed = {theirs: ours for ours, theirs in self.theirs.items()}
        shadowed = {ours: f"recorded {ours}" for ours in self.theirs}
        return tuple((shadowed | renamed).get(name, name) for name in names)

    @classmethod
    def of(cls, profile: Profile, joints: Sequence[str]) -> "Names":
        """What the drivers of a profile call some joints, and the topics on which they are.

        Raises:
            RecordingError: If their states are on several topics.
        """
        parts = [part for part in profile.robots if {*part.joints} & {*joints}]
        measured = sorted({part.state_topic.name for part in parts})
        if len(measured) != 1:
            raise RecordingError(
                f"profile '{profile.name}': the states of these joints are on {len(measured)} topics "
                f"({', '.join(measured)}), and one is read: identify arm and hand apart, by --robot."
            )
        theirs, topics = {}, []
        for part in parts:
            theirs |= {ours: joint.name_in_state for ours, joint in part.joints.items()}
            order = {place: f"{part.name}_{place}" for place in part.held}
            order |= {joint.index_in_command: ours for ours, joint in part.joints.items()}
            topics.append(
                CommandTopic(name=part.command_topic.name, joints=tuple(order[i] for i in sorted(order)))
            )
        return cls(
            command_topics=tuple(topics),
            measured_topic=measured[0],
            theirs={ours: name for ours, name in theirs.items() if ours != name},
        )

    @classmethod
    def parse(
        cls,
        command_topics: Sequence[str],
        measured_topic: str,
        renames: Sequence[str],
        workcell: WorkcellSpec = UR5E_ALLEGRO,
    ) -> "Names":
        """Read the options of the command line.

        Topics are `TOPIC`, `TOPIC=ROBOT` or `TOPIC=JOINT,JOINT,…` with the recording's names; renames are
        `OURS=THEIRS`.

        Raises:
            UnknownNameError: If a joint that is renamed is none of ours.
            InvalidValueError: If an option is of another form, or names something twice.
        """
        pairs: list[tuple[str, str]] = []
        for rename in renames:
            ours, _, theirs = rename.partition("=")
            if not ours or not theirs:
                raise InvalidValueError(
                    f"--rename {rename}: not of the form OURS=THEIRS, such as index_joint_1=joint_1.0"
                )
            if ours not in specs_of(workcell):
                raise UnknownNameError("joint", ours, specs_of(workcell))
            pairs.append((ours, theirs))
        _require_once("--rename", [ours for ours, _ in pairs])
        _require_once("--rename", [theirs for _, theirs in pairs])
        names = cls(measured_topic=measured_topic, theirs=dict(pairs))
        topics = []
        for text in command_topics:
            name, _, joints = text.partition("=")
            known = find_part(workcell, joints) or names.ours(joints.split(",")) if joints else ()
            topics.append(CommandTopic(name=name, joints=known))
        _require_once("--command-topic", [topic.name for topic in topics])
        return replace(names, command_topics=tuple(topics))


def _require_once(option: str, names: Sequence[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InvalidValueError(f"{option} names {', '.join(twice)} twice; name each once")


def read_recording(
    path: Path,
    part: str | None,
    names: Names | None = None,
    workcell: WorkcellSpec = UR5E_ALLEGRO,
    *,
    is_partial: bool = False,
) -> Recording:
    """Read the motion of a part, or of all, in joint order; what the file or folder is chooses the reader.

    A partial recording needs no more than one of the part's joints.

    Raises:
        RecordingError: If it is of no known format, lacks a joint, or says what cannot be.
        UnknownNameError: If there is no such part.
    """
    joints, names = joints_of(workcell, part), names or Names()
    if not path.exists():
        raise RecordingError(f"{path}: there is no such file or folder.")
    if is_bag(path):
        return read_rosbag(path, joints, names, workcell, is_partial=is_partial)
    if path.is_dir() and any((path / name).exists() for name in (MEASURED_FILE, COMMAND_FILE)):
        whole = read_rtde(path, workcell, is_partial=is_partial)
    elif path.suffix == ".npz":
        whole = Recording.load(path, names.ours, workcell)
    else:
        raise RecordingError(f"{path}: {_why_not(path)}")
    found = tuple(joint for joint in joints if joint in whole.joints)
    return whole.select(found if is_partial and found else joints)


def _why_not(path: Path) -> str:
    """Why a file or folder is not read."""
    if path.suffix == ".parquet":
        return (
            "parquet is not read; save its columns with numpy.savez as an .npz file of the arrays joints, "
            "t_cmd, q_cmd, t_meas and q."
        )
    if path.is_dir() and (pieces := [each.name for each in sorted(path.iterdir())]):
        return (
            f"unknown format, a folder with {', '.join(pieces[:MOST_NAMED])}; a recording is {FORMATS}. "
            f"Pieces of a bag need its {METADATA} ('ros2 bag reindex'), or are given file by file."
        )
    return f"unknown format; a recording is {FORMATS}."


@dataclass(frozen=True, kw_only=True)
class _Stream:
    """The motion on one topic."""

    joints: tuple[str, ...]  #: those of the wanted joints that it has, the columns
    recorded: tuple[str, ...]  #: all joints that it has, for messages
    times: np.ndarray  #: when each message was sent [ns]
    fields: dict[str, np.ndarray]  #: `MOTION_FIELDS` that every message has [rad, rad/s, N·m]


@dataclass(frozen=True, kw_only=True)
class _Bag:
    """An open bag, and what is looked for in it."""

    path: Path
    reader: "Reader"
    workcell: WorkcellSpec
    joints: tuple[str, ...]
    names: Names


def read_rosbag(
    path: Path,
    joints: tuple[str, ...],
    names: Names,
    workcell: WorkcellSpec = UR5E_ALLEGRO,
    *,
    is_partial: bool = False,
) -> Recording:
    """Read the motion of some joints from a rosbag2 (MCAP or SQLite), its folder or file.

    A topic's times are its header stamps, or the bag's receive times if any header has none. All are counted
    from the earliest. Several topics of commands become one stream, with a row whenever one of them changes.
    A message without names has the joints in this order, unless `names` tells.

    Raises:
        RecordingError: If a topic or joint is missing, or a message says what cannot be.
    """
    with opened_bag(path, RecordingError, "identification") as reader:
        bag = _Bag(path=path, reader=reader, workcell=workcell, joints=joints, names=names)
        topics = names.command_topics or (CommandTopic(name=_only_command_topic(bag)),)
        measured = _read_topic(bag, CommandTopic(name=names.measured_topic))
        if is_partial and measured.joints:
            bag = replace(bag, joints=measured.joints)
        command_ns, q_cmd = _merged(bag, topics)
    _require_all(f"{path}, topic {names.measured_topic}", bag.joints, [measured])
    start = min(command_ns[0], measured.times[0])
    return Recording(
        name=str(path),
        workcell=workcell,
        joints=bag.joints,
        t_cmd=(command_ns - start) / 1e9,
        q_cmd=q_cmd,
        t_meas=(measured.times - start) / 1e9,
        q=measured.fields["position"],
        qd=measured.fields.get("velocity"),
        effort=measured.fields.get("effort"),
    )


def _only_command_topic(bag: _Bag) -> str:
    types = {connection.topic: connection.msgtype for connection in bag.reader.connections}
    measured = bag.names.measured_topic
    found = sorted(topic for topic, kind in types.items() if kind in MOTION_TYPES and topic != measured)
    if len(found) != 1:
        raise RecordingError(
            f"{bag.path}: {len(found)} topics could carry the commands ({', '.join(found) or 'none'}); "
            f"record one of type {', '.join(MOTION_TYPES)}, or name those that do with --profile or "
            "--command-topic."
        )
    return found[0]


def _merged(bag: _Bag, topics: Sequence[CommandTopic]) -> tuple[np.ndarray, np.ndarray]:
    """Times [ns] at which any command was sent, and positions [rad]; what was not sent then holds."""
    streams = [_read_topic(bag, topic) for topic in topics]
    _require_all(f"{bag.path}, topic {', '.join(topic.name for topic in topics)}", bag.joints, streams)
    times = streams[0].times
    for stream in streams[1:]:
        times = np.sort(np.concatenate((times, stream.times[~np.isin(stream.times, times)])))
    columns = {}
    for stream in streams:
        row = held(stream.times, stream.fields["position"], times)
        columns |= dict(zip(stream.joints, row.T, strict=True))
    return times, np.stack([columns[joint] for joint in bag.joints], axis=-1)


def _require_all(source: str, joints: tuple[str, ...], streams: Sequence[_Stream]) -> None:
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


def _read_topic(bag: _Bag, topic: CommandTopic) -> _Stream:
    """The motion of those of the joints that a topic has."""
    place = Place(source=f"{bag.path}, topic {topic.name}", row="message")
    everything = _messages(bag, place, topic.name)
    concerned = [pair for pair in everything if not pair[1].joints or {*pair[1].joints} & {*bag.joints}]
    if 0 < len(concerned) < len(everything):
        everything, place = concerned, replace(place, row="message of these joints")
    received, motions = zip(*everything, strict=True)
    first = motions[0]
    if first.joints and topic.joints:
        raise RecordingError(
            f"{place.source}: its messages name the joints {', '.join(first.joints)}; "
            f"leave out '=...' behind --command-topic {topic.name}."
        )
    if not first.joints and topic.name == bag.names.measured_topic:
        raise RecordingError(
            f"{place.at(0)}: a joint state without names of joints, so that nobody knows whose positions "
            "these are; let the driver fill in 'name', and record again."
        )
    recorded = first.joints or topic.joints or bag.joints
    for i, motion in enumerate(motions):
        _require_same_order(place.at(i), motion, first, len(recorded))
    joints = tuple(joint for joint in bag.joints if joint in recorded)
    order = [recorded.index(joint) for joint in joints]
    names = [name for name in MOTION_FIELDS if all(name in motion.fields for motion in motions)]
    fields = {name: np.stack([motion.fields[name] for motion in motions])[:, order] for name in names}
    stamps = [message.stamp for message in received]
    times = np.array(stamps if all(stamps) else [message.received for message in received], dtype=np.int64)
    require_motion(place, joints, (times - times[0]) / 1e9, *fields.values(), workcell=bag.workcell)
    return _Stream(joints=joints, recorded=recorded, times=times, fields=fields)


def _messages(bag: _Bag, place: Place, topic: str) -> list[tuple[BagMessage, JointMotion]]:
    """Every message on a topic, and what it says, with our names of the joints."""
    connections = [connection for connection in bag.reader.connections if connection.topic == topic]
    if not connections:
        names = ", ".join(sorted({connection.topic for connection in bag.reader.connections}))
        raise RecordingError(
            f"{bag.path}: no topic {topic}; recorded are: {names or 'none'}. Record it, too."
        )
    messages = []
    for i, message in enumerate(decoded(bag.reader, connections)):
        motion = joint_motion(place.at(i), message)
        messages.append((message, replace(motion, joints=bag.names.ours(motion.joints))))
    if not messages:
        raise RecordingError(f"{place.source}: empty, there is no message; record again.")
    return messages


def _require_same_order(where: str, motion: JointMotion, first: JointMotion, num_joints: int) -> None:
    if motion.joints != first.joints:
        raise RecordingError(
            f"{where}: joints {', '.join(motion.joints)}, but the first message has "
            f"{', '.join(first.joints)}; two publishers share the topic: choose the --robot whose joints "
            "one of them has, or record them on topics of their own."
        )
    for name, values in motion.fields.items():
        if len(values) != num_joints:
            raise RecordingError(
                f"{where}: {len(values)} numbers in {name} for {num_joints} joints; publish one number a "
                "joint, choose the --robot that has so many, or say which: --command-topic TOPIC=JOINT,..."
            )
