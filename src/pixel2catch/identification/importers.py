"""Read a recording from a rosbag2 or from tables, with a laboratory's names of topics and joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pixel2catch.arrays import numbers_of, table_columns
from pixel2catch.errors import RecordingError
from pixel2catch.identification.recording import Recording, held, require_joints, require_motion
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.ros2.bags import METADATA, BagMessage, decoded, is_bag, opened_bag
from pixel2catch.ros2.profile import Profile

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

STATE, TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
MOTION_TYPES = (STATE, TRAJECTORY, "std_msgs/msg/Float64MultiArray")  # messages with joint positions
COMMAND_TABLE = "commands.csv"  # the sent commands; another .csv file of its folder has the measurements
MEASURED_TOPIC = "/joint_states"  # topic of the measurements. Source: ROS 2, `joint_state_broadcaster`.


@dataclass(frozen=True, kw_only=True)
class RecordedNames:
    """Names of topics and joints in a laboratory's recordings."""

    #: topics of the commands, each with the joints of messages that name none; by default the only topic
    command_topics: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    measured_topic: str = MEASURED_TOPIC  #: topic of the measurements
    joints: Mapping[str, str] = field(default_factory=dict)  #: the work cell's names, by the recorded ones

    def renamed(self, recorded: Sequence[str]) -> tuple[str, ...]:
        """Return the work cell's names of recorded joints; mark other joints that have one of its names."""
        taken = {ours: f"recorded {ours}" for ours in self.joints.values()}
        return tuple(({**taken, **self.joints}).get(name, name) for name in recorded)

    @classmethod
    def of(cls, profile: Profile, joints: Sequence[str]) -> "RecordedNames":
        """Return the names that the drivers of a profile have for some joints and their topics."""
        drivers = [part for part in profile.robots if {*part.joints} & {*joints}]
        measured = sorted({part.state_topic.name for part in drivers})
        if len(measured) != 1:
            raise RecordingError(
                f"profile '{profile.name}': the states of these joints are on {len(measured)} topics "
                f"({', '.join(measured)}), but one is read; identify arm and hand separately, with --robot."
            )
        names, topics = {}, {}
        for part in drivers:
            names |= {joint.name_in_state: ours for ours, joint in part.joints.items()}
            order = {place: f"{part.name}_{place}" for place in part.held}
            order |= {joint.index_in_command: ours for ours, joint in part.joints.items()}
            topics[part.command_topic.name] = tuple(order[place] for place in sorted(order))
        renamed = {theirs: ours for theirs, ours in names.items() if ours != theirs}
        return cls(command_topics=topics, measured_topic=measured[0], joints=renamed)


@dataclass(frozen=True, kw_only=True)
class _Stream:
    """The motion on one topic."""

    joints: tuple[str, ...]  #: those of the wanted joints that it has, the columns
    recorded: tuple[str, ...]  #: all joints that it has
    times: np.ndarray  #: when each message was sent [ns]
    positions: np.ndarray  #: the positions, a row for each message [rad]


@dataclass(frozen=True, kw_only=True)
class _Bag:
    path: Path
    reader: "Reader"
    workcell: WorkcellSpec
    joints: tuple[str, ...]
    names: RecordedNames


def read_rosbag(
    path: Path, joints: tuple[str, ...], names: RecordedNames | None, workcell: WorkcellSpec
) -> Recording:
    """Read the motion of those of some joints that a rosbag2 (MCAP or SQLite, its folder or file) measured.

    A topic's times are its header stamps, or the bag's receive times if a header has none or all have the
    same, counted from the earliest. Several topics of commands become one stream, with a row whenever one of
    them changes. Raises RecordingError for no bag, a missing topic or command, or impossible motion.
    """
    names = names or RecordedNames()
    if not is_bag(path):
        raise RecordingError(
            f"{path}: not a recording; give an .npz file (arrays joints, t_cmd, q_cmd, t_meas, q), a "
            f"rosbag2: its folder with {METADATA}, its .mcap or its .db3 file (a ROS 1 .bag: "
            f"convert it with 'rosbags-convert'), or a folder with {COMMAND_TABLE} and a .csv file of the "
            "measurements."
        )
    with opened_bag(path, RecordingError, "identification") as reader:
        bag = _Bag(path=path, reader=reader, workcell=workcell, joints=joints, names=names)
        topics = names.command_topics or {_only_command_topic(bag): ()}
        measured = _read_topic(bag, names.measured_topic, ())
        if not measured.joints:
            require_joints(f"{path}, topic {names.measured_topic}", joints, measured.recorded)
        bag = replace(bag, joints=measured.joints)
        command_ns, q_cmd = _merged(bag, topics)
    start, q = min(command_ns[0], measured.times[0]), measured.positions
    t_cmd, t_meas = (command_ns - start) / 1e9, (measured.times - start) / 1e9
    robot = {"name": str(path), "workcell": workcell, "joints": bag.joints}
    return Recording(**robot, t_cmd=t_cmd, q_cmd=q_cmd, t_meas=t_meas, q=q)


def read_tables(
    folder: Path, joints: tuple[str, ...], names: RecordedNames | None, workcell: WorkcellSpec
) -> Recording:
    """Read the motion of those of some joints that two tables have: commands, and measurements as of RTDE.

    The time [s] is in column t, time or timestamp; positions [rad] are in columns named as the joints, or
    q_0, q_1, ... or actual_q_0, ... in their order. Raises RecordingError without one table of measurements,
    for a missing column, or for impossible motion.
    """
    others = sorted(path for path in folder.glob("*.csv") if path.name != COMMAND_TABLE)
    if len(others) != 1:
        found = ", ".join(path.name for path in others) or "none"
        raise RecordingError(f"{folder}: {found} beside {COMMAND_TABLE}; leave one .csv of the measurements.")
    ours = {"time": "t", "timestamp": "t", **(names.joints if names else {})}
    ours |= {f"{kind}_{i}": joint for i, joint in enumerate(joints) for kind in ("q", "actual_q")}
    paths = (folder / COMMAND_TABLE, others[0])
    tables = [{ours.get(name, name): cells for name, cells in table_columns(path).items()} for path in paths]
    joints = tuple(joint for joint in joints if all(joint in table for table in tables)) or joints
    command, measured = (
        numbers_of(path, table, ("t", *joints)) for path, table in zip(paths, tables, strict=True)
    )
    robot = {"name": str(folder), "workcell": workcell, "joints": joints}
    t_cmd, t_meas = command[:, 0], measured[:, 0]
    return Recording(**robot, t_cmd=t_cmd, q_cmd=command[:, 1:], t_meas=t_meas, q=measured[:, 1:])


def _only_command_topic(bag: _Bag) -> str:
    types = {connection.topic: connection.msgtype for connection in bag.reader.connections}
    measured = bag.names.measured_topic
    found = sorted(topic for topic, kind in types.items() if kind in MOTION_TYPES and topic != measured)
    if len(found) != 1:
        raise RecordingError(
            f"{bag.path}: {len(found)} topics could carry the commands ({', '.join(found) or 'none'}); "
            f"record one of type {', '.join(MOTION_TYPES)}, or name the topic with --profile or "
            "--command-topic."
        )
    return found[0]


def _merged(bag: _Bag, topics: Mapping[str, tuple[str, ...]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the times [ns] of commands on any topic, and positions [rad]; the others hold meanwhile."""
    streams = [_read_topic(bag, topic, unnamed) for topic, unnamed in topics.items()]
    source = f"{bag.path}, topic {', '.join(topics)}"
    found = [joint for stream in streams for joint in stream.joints]
    if not {*bag.joints} <= {*found}:
        require_joints(source, bag.joints, (name for each in streams for name in each.recorded))
    if twice := sorted({joint for joint in found if found.count(joint) > 1}):
        raise RecordingError(f"{source}: {', '.join(twice)} is on several topics; command it on one.")
    times = streams[0].times
    for stream in streams[1:]:
        times = np.sort(np.concatenate((times, stream.times[~np.isin(stream.times, times)])))
    rows = np.concatenate([held(stream.times, stream.positions, times) for stream in streams], axis=1)
    return times, rows[:, [found.index(joint) for joint in bag.joints]]


def _read_topic(bag: _Bag, topic: str, unnamed: tuple[str, ...]) -> _Stream:
    """Return the motion on a topic; `unnamed` are the joints of messages without names."""
    source = f"{bag.path}, topic {topic}"
    connections = [connection for connection in bag.reader.connections if connection.topic == topic]
    if not connections:
        names = ", ".join(sorted({connection.topic for connection in bag.reader.connections}))
        raise RecordingError(f"{bag.path}: no topic {topic}; recorded are {names or 'none'}. Record it, too.")
    everything = []
    for i, message in enumerate(decoded(bag.reader, connections)):
        names, numbers = _joint_motion(f"{source}, message {i}", message)
        everything.append((message, bag.names.renamed(names), numbers))
    if not everything:
        raise RecordingError(f"{source}: empty, there is no message; record again.")
    concerned = [entry for entry in everything if not entry[1] or {*entry[1]} & {*bag.joints}]
    received, names_of, rows = zip(*(concerned or everything), strict=True)
    if not names_of[0] and topic == bag.names.measured_topic:
        problem = "a joint state without names of joints"
        raise RecordingError(f"{source}: {problem}; let the driver fill in 'name', and record again.")
    recorded = names_of[0] or unnamed or bag.joints
    for i, (names, numbers) in enumerate(zip(names_of, rows, strict=True)):
        _require_same_order(f"{source}, message {i}", names, names_of[0], len(numbers), len(recorded))
    joints = tuple(joint for joint in bag.joints if joint in recorded)
    if twice := [joint for joint in joints if recorded.count(joint) > 1]:
        raise RecordingError(f"{source}: {', '.join(twice)} is twice in a message; name each joint once.")
    positions = np.stack(rows)[:, [recorded.index(joint) for joint in joints]]
    stamps = [message.stamp for message in received]
    is_stamped = all(stamps) and len({*stamps}) > 1
    times = np.array(stamps if is_stamped else [message.received for message in received], dtype=np.int64)
    require_motion(source, joints, (times - times[0]) / 1e9, positions, bag.workcell)
    return _Stream(joints=joints, recorded=recorded, times=times, positions=positions)


def _joint_motion(where: str, message: BagMessage) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names, if any, and the positions [rad] of a message of one of `MOTION_TYPES`."""
    content, kind = message.content, message.type
    if kind not in MOTION_TYPES:
        raise RecordingError(f"{where}: type {kind} is not read; record {', '.join(MOTION_TYPES)}.")
    if kind == TRAJECTORY and len(content.points) != 1:
        raise RecordingError(
            f"{where}: a trajectory of {len(content.points)} points, which a controller interpolates; "
            "record the targets that are streamed to the joints, one point in each message."
        )
    if kind == STATE and not len(content.position):
        raise RecordingError(f"{where}: a joint state without positions; record one that has them.")
    if kind == STATE:
        joints, positions = content.name, content.position
    elif kind == TRAJECTORY:
        joints, positions = content.joint_names, content.points[0].positions
    else:
        joints, positions = (), content.data
    return tuple(joints), np.asarray(positions, dtype=np.float64)


def _require_same_order(
    where: str, joints: tuple[str, ...], first: tuple[str, ...], num_positions: int, num_joints: int
) -> None:
    if joints != first:
        raise RecordingError(
            f"{where}: joints {', '.join(joints)}, but the first message has "
            f"{', '.join(first)}; two publishers share the topic: choose the --robot of one of them, "
            "or record them on two topics."
        )
    if num_positions != num_joints:
        raise RecordingError(
            f"{where}: {num_positions} positions for {num_joints} joints; publish one number per "
            "joint, choose the --robot with that many joints, or name the --profile."
        )
