"""Bags of an arm and a hand in both storages, and what makes one unusable."""

import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import ARM, ROBOTS, assert_same, short
from rosbags.rosbag2 import CompressionMode, StoragePlugin, reader, storage_mcap

from pixel2catch.errors import RecordingError
from pixel2catch.identification.importers import RecordedNames, read_rosbag, read_tables
from pixel2catch.identification.recording import Recording
from pixel2catch.ros2.messages import read_float_array
from pixel2catch.ros2.profile import Profile
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO
from ros_bags import EPOCH, TYPES, Message, header, joint_state, save_bag

FINGERS = ROBOTS["allegro"]
ALL = ARM + FINGERS
JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
NANOSECOND = 1e-9
SHUFFLED = [2, 1, 0, 3, 4, 5]
"""UR's driver publishes the elbow first."""


def read(path: Path, joints: tuple[str, ...], names: RecordedNames | None = None) -> Recording:
    return read_rosbag(path, joints, names, UR5E_ALLEGRO)


def nanoseconds(time: float) -> int:
    return EPOCH * 10**9 + round(time * 1e9)


def trajectory(time: int, names: Iterable[str], *points: np.ndarray) -> Any:
    duration, empty = TYPES["builtin_interfaces/msg/Duration"](sec=0, nanosec=0), np.zeros(0)
    point_type = TYPES["trajectory_msgs/msg/JointTrajectoryPoint"]
    targets = [point_type(np.array(point), empty, empty, empty, duration) for point in points]
    return TYPES[TRAJECTORY](header(time), list(names), targets)


def array(values: np.ndarray) -> Any:
    return TYPES[ARRAY](TYPES["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0), np.array(values))


Make = Callable[[int, np.ndarray], Any]
"""Returns a message with a stamp [ns] and positions."""


def stream(topic: str, times: np.ndarray, rows: np.ndarray, make: Make, late: int = 0) -> list[Message]:
    """A message for each time [s], received later by a delay [ns]."""
    stamps = map(nanoseconds, times)
    return [(topic, at + late, make(at, row)) for at, row in zip(stamps, rows, strict=True)]


def states(recording: Recording, joints: Sequence[str], late: int = 0) -> list[Message]:
    """Joint states of some joints alone, as a publisher of its own sends them."""
    rows = recording.select(tuple(joints)).q
    return stream("/joint_states", recording.t_meas, rows, lambda at, row: joint_state(at, joints, row), late)


def measured(recording: Recording, order: list[int] = SHUFFLED) -> list[Message]:
    """Joint states whose receive time is 3 ms behind their stamp, with a joint that nobody asks for."""
    rows = np.pad(recording.q[:, order], ((0, 0), (0, 1)), constant_values=99.0)
    names = [*(ARM[i] for i in order), "gripper_joint"]
    return stream(
        "/joint_states", recording.t_meas, rows, lambda at, row: joint_state(at, names, row), 3_000_000
    )


def commands(recording: Recording, kind: str) -> list[Message]:
    """The commands as messages of a type; an array has only the time at which it was received."""
    makers: dict[str, Make] = {
        JOINT_STATE: lambda at, row: joint_state(at, recording.joints, row),
        TRAJECTORY: lambda at, row: trajectory(at, recording.joints, row),
        ARRAY: lambda at, row: array(row),
    }
    late = 0 if kind == ARRAY else 5_000_000
    return stream("/command", recording.t_cmd, recording.q_cmd, makers[kind], late)


def test_a_bag_that_is_read_leaves_rosbags_as_it_was(tmp_path: Path):
    path = save_bag(tmp_path / "bag", measured(short()) + commands(short(), TRAJECTORY))
    before = [dict(vars(module)) for module in (reader, storage_mcap)]
    read(path, ARM)
    assert [dict(vars(module)) for module in (reader, storage_mcap)] == before


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_bag_keeps_both_clocks(storage: StoragePlugin, tmp_path: Path):
    """Stamps count, not receive times, in any order of joints; from the folder or the file."""
    for kind in (JOINT_STATE, TRAJECTORY, ARRAY):
        sent = measured(short()) + commands(short(), kind)
        path = save_bag(tmp_path / kind.replace("/", "."), sent, storage)
        assert_same(read(path, ARM), short(), NANOSECOND)
        (file,) = (each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
        assert_same(read(file, ARM), short(), NANOSECOND)


def test_files_of_a_split_bag_that_overlap_are_merged(tmp_path: Path):
    """The second file begins before the first ends, as the recorder's cache makes it."""
    sent = sorted(measured(short()) + commands(short(), TRAJECTORY), key=lambda message: message[1])
    parts = sent[:9] + sent[10:11], sent[9:10] + sent[11:]
    first, second = (save_bag(tmp_path / f"bag{i}", part) for i, part in enumerate(parts))
    name = next(second.glob("*.mcap")).rename(first / "second.mcap").name
    content = (first / "metadata.yaml").read_text()
    listed = next(line for line in content.splitlines() if line.strip() == f"- {first.name}.mcap")
    both = f"{listed}\n{listed.replace('bag0.mcap', name)}"
    (first / "metadata.yaml").write_text(content.replace(listed, both))
    assert_same(read(first, ARM), short(), NANOSECOND)
    with pytest.warns(UserWarning, match=r"second.mcap alone is read, one of the 2 files"):
        read(first / "second.mcap", ARM)


@pytest.mark.parametrize("stamp", [0, nanoseconds(0.0)])
def test_optional_signals_may_be_nan_and_stamps_stand_still(stamp: int, tmp_path: Path):
    """Without stamps that increase, the times of recording count: 3 ms later than those of the clock."""
    sent = measured(short())
    for *_, message in sent:
        message.velocity = message.effort = np.full(7, np.nan)
        message.header = header(stamp)
    path = save_bag(tmp_path / "bag", sent + commands(short(), TRAJECTORY))
    assert_same(read(path, ARM), replace(short(), t_meas=short().t_meas + 0.003), NANOSECOND)


def test_what_is_wrong_with_a_description_is_said(tmp_path: Path):
    path = save_bag(tmp_path / "bag", measured(short()))
    text = (path / "metadata.yaml").read_text()
    for content, words in (
        (text.encode("utf-16"), r"metadata.yaml': it is not UTF-8 text .* by 'ros2 bag reindex'"),
        (re.sub("version: .", "version: 99", text, count=1).encode(), "version 99 .*, or one file"),
    ):
        (path / "metadata.yaml").write_bytes(content)
        with pytest.raises(RecordingError, match=words):
            read(path, ARM)


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_bag_may_be_compressed(mode: CompressionMode, tmp_path: Path):
    sent = measured(short()) + commands(short(), TRAJECTORY)
    path = save_bag(tmp_path / "bag", sent, StoragePlugin.SQLITE3, mode)
    assert_same(read(path, ARM), short(), NANOSECOND)
    (file,) = path.glob("*.db3*")
    if mode is CompressionMode.FILE:
        assert_same(read(file, ARM), short(), NANOSECOND)
    else:
        with pytest.raises(RecordingError, match=r"its messages are compressed, .* give its folder"):
            read(file, ARM)


def test_channels_of_an_mcap_file_that_are_not_ros_are_left_out(tmp_path: Path):
    """A logger's channel with a schema of Protobuf, which is no text, in a file of any profile."""
    text = TYPES["std_msgs/msg/String"]("x")
    sent = [*measured(short()), *commands(short(), TRAJECTORY), ("/log", nanoseconds(0.1), text)]
    (file,) = save_bag(tmp_path / "bag", sent).glob("*.mcap")
    content = file.read_bytes().replace(b"/log\3\0\0\0cdr", b"/log\3\0\0\0pb3")
    schema = re.compile(rb"(?<=std_msgs/msg/String\x07\0\0\0)ros2msg(.{4}).", re.DOTALL)
    content = schema.sub(lambda found: b"protob2" + found[1] + b"\xff", content)
    file.write_bytes(content.replace(b"\4\0\0\0ros2", b"\4\0\0\0ros1", 1))
    assert_same(read(file, ARM), short(), NANOSECOND)
    file.write_bytes(content.replace(b"\3\0\0\0cdr", b"\3\0\0\0pb3"))
    with pytest.raises(RecordingError, match="have the encoding pb3, but only cdr, of ROS 2, is read"):
        read(file, ARM)


def test_one_of_several_command_topics_is_chosen_by_name(tmp_path: Path):
    other = [("/other", nanoseconds(0.1), array(np.zeros(13)))]
    path = save_bag(tmp_path / "bag", measured(short()) + commands(short(), ARRAY) + other)
    with pytest.raises(RecordingError, match=r"2 topics could .* \(/command, /other\); .* --command-topic"):
        read(path, ARM)
    assert_same(read(path, ARM, RecordedNames(command_topics={"/command": ()})), short(), NANOSECOND)


def one_state(*args: Any) -> list[Message]:
    """Joint states whose third message is made of these arguments."""
    messages = measured(short())
    return [*messages[:2], (*messages[2][:2], joint_state(nanoseconds(0.1), *args)), *messages[3:]]


NAMES = [*(ARM[i] for i in SHUFFLED), "gripper_joint"]
SWAPPED = [*measured(short())[:4], *measured(short(), order=[0, 1, 2, 3, 4, 5])[4:]]
SENT = commands(short(), TRAJECTORY)
PLAN = [("/command", nanoseconds(0.6), trajectory(nanoseconds(0.6), ARM, np.ones(6), np.ones(6)))]
WIDE = [("/command", nanoseconds(0.1), array(np.zeros(13)))]
TWICE = [
    ("/joint_states", at, joint_state(at, [*NAMES[:6], ARM[0]], message.position))
    for _, at, message in measured(short())
]
UNNAMED = [
    ("/joint_states", at, joint_state(at, (), message.position[:6])) for _, at, message in measured(short())
]


@pytest.mark.parametrize(
    ("messages", "message"),
    [
        (SENT, "no topic /joint_states; recorded are /command. Record it"),
        (SWAPPED + SENT, "message 4: joints .* two publishers share"),
        (measured(short()) + SENT + PLAN, "message 5: a trajectory of 2 po"),
        (one_state(NAMES, np.ones(5)) + SENT, "message 2: 5 positions for 7"),
        (TWICE + SENT, "/joint_states: shoulder_pan_joint is twice in a message; name each joint once"),
        (UNNAMED + SENT, "a joint state without names of joints.* fill in 'name'"),
        (measured(short()) + WIDE, "topic /command, message 0: 13 positions for 6 joints"),
    ],
)
def test_error_names_topic_message_and_fix(messages: list[Message], message: str, tmp_path: Path):
    path = save_bag(tmp_path / "bag", messages)
    with pytest.raises(RecordingError, match=message) as caught:
        read(path, ARM)
    assert str(path) in str(caught.value)


def write_table(path: Path, names: list[str], rows: np.ndarray, separator: str, point: str) -> None:
    lines = [separator.join(f"{number:.9f}".replace(".", point) for number in row) for row in rows]
    path.write_text("\r\n".join((separator.join(names), *lines)), encoding="utf-8-sig")


def tables(folder: Path, time: str = "t", separator: str = ",", point: str = ".") -> Path:
    """The commands by numbers of joints, the measurements as RTDE names them, with a column more."""
    folder.mkdir()
    sent = np.column_stack((short().t_cmd, short().q_cmd))
    write_table(folder / "commands.csv", [time, *(f"q_{i}" for i in range(6))], sent, separator, point)
    names = ["timestamp", *(f"actual_q_{i}" for i in range(6)), "target_q_0"]
    rows = np.column_stack((short().t_meas, short().q, short().q[:, 0] + 1.0))
    write_table(folder / "rtde.csv", names, rows, separator, point)
    return folder


@pytest.mark.parametrize(
    ("separator", "point"), [(",", "."), (";", ","), (";", "."), ("\t", ","), (" ", ","), (" ", ".")]
)
def test_tables_have_any_separator_and_decimal_commas(separator: str, point: str, tmp_path: Path):
    got = read_tables(tables(tmp_path / "log", separator=separator, point=point), ALL, None, UR5E_ALLEGRO)
    assert_same(got, short(), NANOSECOND)


def test_tables_that_do_not_fit_are_named(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"commands\.csv': no column t; it has"):
        read_tables(tables(tmp_path / "log", time="when"), ARM, None, UR5E_ALLEGRO)


def test_other_files_and_a_missing_library_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(RecordingError, match=r"notes\.txt: not a recording; give an \.npz file"):
        read(tmp_path / "notes.txt", ARM)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(RecordingError, match=r"needs rosbags.*pip install .*\[identification\]"):
        read(tmp_path / "bag.mcap", ARM)


def wide(arm: np.ndarray) -> np.ndarray:
    return np.hstack((arm, np.repeat(0.1 * arm[:, 2:3], len(FINGERS), axis=1)))


WITH_HAND = replace(short(), joints=ALL, q_cmd=wide(short().q_cmd), q=wide(short().q))
"""The arm's motion with a hand whose joints copy the elbow's, a tenth as far."""


def two_topics(recording: Recording) -> list[Message]:
    """The arm's commands as trajectories, and 50 ms later the hand's, as 16 numbers without names."""
    arm, hand, late = recording.q_cmd[:, :6], recording.q_cmd[:, 6:], recording.t_cmd + 0.05
    fingers = np.pad(hand, ((0, 0), (3, 0)), constant_values=0.9)
    return [
        *stream("/arm", recording.t_cmd, arm, lambda at, row: trajectory(at, ARM, row)),
        *stream("/hand", late, fingers, lambda at, row: array(row)),
    ]


SPARE = ("spare_1", "spare_2", "spare_3")
BOTH = {"/arm": (), "/hand": (*SPARE, *FINGERS)}


def test_commands_of_two_topics_hold_on_their_own_clocks(tmp_path: Path):
    """At 0.1 s the arm gets its second command, the hand still has its first; at 0.15 s it has the second."""
    recording = WITH_HAND
    path = save_bag(tmp_path / "bag", states(recording, ALL) + two_topics(recording))
    got = read(path, ALL, RecordedNames(command_topics=BOTH))
    np.testing.assert_allclose(got.t_cmd, np.arange(10) * 0.05, atol=NANOSECOND)
    np.testing.assert_array_equal(got.q_cmd[:, :6], np.repeat(recording.q_cmd[:, :6], 2, axis=0))
    hand = np.concatenate((recording.q_cmd[:1], np.repeat(recording.q_cmd, 2, axis=0)))[:10, 6:]
    np.testing.assert_array_equal(got.q_cmd[:, 6:], hand)
    np.testing.assert_array_equal(got.q, recording.q)


def test_one_part_is_read_from_topics_of_two_publishers(tmp_path: Path):
    recording = WITH_HAND
    late = replace(recording, t_meas=recording.t_meas + 0.01)
    path = save_bag(tmp_path / "bag", states(recording, ARM) + states(late, FINGERS) + two_topics(recording))
    hand = read(path, FINGERS, RecordedNames(command_topics={"/hand": BOTH["/hand"]}))
    np.testing.assert_array_equal(hand.q, recording.q[:, 6:])
    np.testing.assert_allclose(hand.t_meas[0] - hand.t_cmd[0], 0.02 + 0.01 - 0.05, atol=NANOSECOND)
    with pytest.raises(RecordingError, match="two publishers share the topic"):
        read(path, ALL, RecordedNames(command_topics=BOTH))


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        ({"/arm": ()}, "topic /arm: no joint index_joint_1, .*--profile"),
        ({"/arm": (), "/hand": ("spare", *ARM[1:3], *FINGERS)}, "topic /arm, /hand: elbow_joint, .* several"),
    ],
)
def test_topics_that_do_not_fit_are_named(topics: dict[str, tuple[str, ...]], message: str, tmp_path: Path):
    path = save_bag(tmp_path / "bag", states(WITH_HAND, ALL) + two_topics(WITH_HAND))
    with pytest.raises(RecordingError, match=message):
        read(path, ALL, RecordedNames(command_topics=topics))


def test_a_name_of_ours_on_another_joint_is_not_taken_for_ours():
    names = RecordedNames(
        joints={"wrist_1_joint": "elbow_joint", "elbow_joint": "wrist_1_joint", "e": "wrist_2_joint"}
    )
    recorded = ("elbow_joint", "wrist_1_joint", "e", "wrist_2_joint")
    assert names.renamed(recorded)[:3] == ("wrist_1_joint", "elbow_joint", "wrist_2_joint")
    assert names.renamed(recorded)[3] != "wrist_2_joint"


def test_a_profile_has_topics_and_names(tmp_path: Path):
    """Its hand begins with the thumb and has other names; three joints of its fingers are held."""
    profile, order = Profile.load("ur5e_allegro_v4"), [joint.name for joint in UR5E_ALLEGRO.joints]
    recording = WITH_HAND.select(tuple(order))
    names = [theirs.name_in_state for part in profile.robots for theirs in part.joints.values()]
    ours = tuple(joint for part in profile.robots for joint in part.joints)
    rows = recording.select(ours).q
    messages = stream("/joint_states", recording.t_meas, rows, lambda at, row: joint_state(at, names, row))
    for robot in profile.robots:
        sent = [read_float_array(robot.command(row, robot.held_angles)) for row in recording.q_cmd]
        topic = robot.command_topic.name
        messages += stream(topic, recording.t_cmd, np.array(sent), lambda at, row: array(row))
    path = save_bag(tmp_path / "bag", messages)
    assert_same(read(path, ALL, RecordedNames.of(profile, order)), recording, 1e-6)
