"""Bags written with rosbags, in both storages, and what makes one unusable."""

import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import ARM, assert_same, short
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pixel2catch.errors import RecordingError
from pixel2catch.identification.importers import read_recording
from pixel2catch.identification.recording import Recording

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES: dict[str, Any] = STORE.types
JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
EPOCH_NS = 1_790_000_000 * 10**9
NANOSECOND = 1e-9
SHUFFLED = [2, 1, 0, 3, 4, 5]
"""UR's driver publishes the elbow first."""

Message = tuple[str, int, Any]
"""Topic, time [ns], message."""


def header(time: int) -> Any:
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id="")


def nanoseconds(time: float) -> int:
    return EPOCH_NS + round(time * 1e9)


def joint_state(time: int, names: Iterable[str], position, velocity=(), effort=()) -> Any:
    numbers = (np.array(values, dtype=np.float64) for values in (position, velocity, effort))
    return TYPES[JOINT_STATE](header(time), list(names), *numbers)


def trajectory(time: int, names: Iterable[str], *points: np.ndarray) -> Any:
    duration, empty = TYPES["builtin_interfaces/msg/Duration"](sec=0, nanosec=0), np.zeros(0)
    point_type = TYPES["trajectory_msgs/msg/JointTrajectoryPoint"]
    targets = [point_type(np.array(point), empty, empty, empty, duration) for point in points]
    return TYPES[TRAJECTORY](header(time), list(names), targets)


def array(values: np.ndarray) -> Any:
    return TYPES[ARRAY](TYPES["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0), np.array(values))


def measured(recording: Recording, order: list[int] = SHUFFLED) -> list[Message]:
    """Joint states whose receive time is 3 ms behind their stamp, with a joint that nobody asks for."""
    messages = []
    assert recording.qd is not None
    assert recording.effort is not None
    names = [*(ARM[i] for i in order), "gripper_joint"]
    for time, *signals in zip(recording.t_meas, recording.q, recording.qd, recording.effort, strict=True):
        numbers = [[*signal[order], 99.0] for signal in signals]
        stamp = nanoseconds(time)
        messages.append(("/joint_states", stamp + 3_000_000, joint_state(stamp, names, *numbers)))
    return messages


def commands(recording: Recording, kind: str) -> list[Message]:
    """The commands as messages of a type; an array has only the time at which it was received."""
    messages = []
    for time, position in zip(recording.t_cmd, recording.q_cmd, strict=True):
        stamp = nanoseconds(time)
        message = {
            JOINT_STATE: lambda s=stamp, p=position: joint_state(s, ARM, p),
            TRAJECTORY: lambda s=stamp, p=position: trajectory(s, ARM, p),
            ARRAY: lambda p=position: array(p),
        }[kind]()
        messages.append(("/command", stamp + (0 if kind == ARRAY else 5_000_000), message))
    return messages


def write_bag(path: Path, messages: list[Message], storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with Writer(path, version=9, storage_plugin=storage) as bag:
        connections = {}
        for topic, time, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            data = STORE.serialize_cdr(message, message.__msgtype__)
            bag.write(connections[topic], time, data)
    return path


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("kind", [JOINT_STATE, TRAJECTORY, ARRAY])
def test_bag_keeps_both_clocks(storage: StoragePlugin, kind: str, tmp_path: Path):
    """Stamps count, not receive times; whatever the publisher's joint order, ours comes out."""
    path = write_bag(tmp_path / "bag", measured(short()) + commands(short(), kind), storage)
    assert_same(read_recording(path, "ur5e"), short(), NANOSECOND)
    (file,) = (each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
    assert_same(read_recording(file, "ur5e"), short(), NANOSECOND)


def test_receive_times_count_where_a_stamp_is_missing(tmp_path: Path):
    messages = [
        (topic, time, trajectory(0, message.joint_names, message.points[0].positions))
        for topic, time, message in commands(short(), TRAJECTORY)
    ]
    recording = read_recording(write_bag(tmp_path / "bag", measured(short()) + messages), "ur5e")
    later = replace(short(), t_cmd=short().t_cmd + 0.005)
    np.testing.assert_allclose(
        recording.t_meas[0] - recording.t_cmd[0], later.t_meas[0] - later.t_cmd[0], atol=NANOSECOND
    )


def test_speed_and_effort_are_optional(tmp_path: Path):
    messages = [
        (topic, time, joint_state(nanoseconds(at), message.name, message.position))
        for (topic, time, message), at in zip(measured(short()), short().t_meas, strict=True)
    ]
    path = write_bag(tmp_path / "bag", messages + commands(short(), ARRAY))
    assert_same(read_recording(path, "ur5e"), replace(short(), qd=None, effort=None), NANOSECOND)


def test_one_of_several_command_topics_is_chosen_by_name(tmp_path: Path):
    other = [("/other", nanoseconds(0.1), array(np.zeros(13)))]
    path = write_bag(tmp_path / "bag", measured(short()) + commands(short(), ARRAY) + other)
    with pytest.raises(RecordingError, match=r"2 topics could .* \(/command, /other\); .* --command-topic"):
        read_recording(path, "ur5e")
    assert_same(read_recording(path, "ur5e", command_topic="/command"), short(), NANOSECOND)


def swapped_order() -> list[Message]:
    return [*measured(short())[:4], *measured(short(), order=[0, 1, 2, 3, 4, 5])[4:]]


def one_state(*args: Any) -> list[Message]:
    """Joint states whose third message is made of these arguments."""
    messages = measured(short())
    return [*messages[:2], (*messages[2][:2], joint_state(nanoseconds(0.1), *args)), *messages[3:]]


NAMES = [*(ARM[i] for i in SHUFFLED), "gripper_joint"]
AGAIN = [("/command", nanoseconds(0.6), trajectory(nanoseconds(0.0), ARM, np.ones(6)))]
PLAN = [("/command", nanoseconds(0.6), trajectory(nanoseconds(0.6), ARM, np.ones(6), np.ones(6)))]
TEXT = [("/command", nanoseconds(0.6), TYPES["std_msgs/msg/String"](data="go"))]


@pytest.mark.parametrize(
    ("messages", "message"),
    [
        (lambda: commands(short(), ARRAY), "no topic /joint_states; recorded are: /command. Record it"),
        (lambda: measured(short()), r"0 topics could carry the commands \(none\); record one of type"),
        (lambda: measured(short()) + TEXT, "0 topics could carry the commands"),
        (lambda: swapped_order() + commands(short(), ARRAY), "message 4: joints .* two publishers share"),
        (lambda: measured(short()) + commands(short(), TRAJECTORY) + AGAIN, "message 5: time runs backwards"),
        (lambda: measured(short()) + commands(short(), TRAJECTORY) + PLAN, "message 5: a trajectory of 2 po"),
        (lambda: one_state(NAMES, np.ones(5)) + commands(short(), ARRAY), "message 2: 5 numbers in position"),
        (lambda: one_state(NAMES, ()) + commands(short(), ARRAY), "message 2: a joint state without posit"),
        (
            lambda: one_state(NAMES, np.full(7, np.nan)) + commands(short(), ARRAY),
            "topic /joint_states, message 2, column shoulder_pan_joint: nan is no number",
        ),
        (
            lambda: one_state(NAMES, np.full(7, 90.0)) + commands(short(), ARRAY),
            "message 2, column shoulder_pan_joint: 90 rad .* in degrees, convert",
        ),
        (
            lambda: [*measured(short()), ("/command", nanoseconds(0.1), array(np.zeros(13)))],
            "topic /command, message 0: 13 numbers in position for 6 joints",
        ),
    ],
)
def test_error_names_topic_message_and_fix(messages, message: str, tmp_path: Path):
    path = write_bag(tmp_path / "bag", messages())
    with pytest.raises(RecordingError, match=message) as caught:
        read_recording(path, "ur5e")
    assert str(path) in str(caught.value)


def test_missing_joint_is_named(tmp_path: Path):
    path = write_bag(tmp_path / "bag", measured(short()) + commands(short(), TRAJECTORY))
    with pytest.raises(
        RecordingError, match=r"topic /command: no joint index_joint_1, .* it has shoulder_pan"
    ):
        read_recording(path, "ur5e_allegro")


def test_unread_type_is_named(tmp_path: Path):
    path = write_bag(tmp_path / "bag", measured(short()) + TEXT)
    with pytest.raises(RecordingError, match="type std_msgs/msg/String is not read; record sensor_msgs"):
        read_recording(path, "ur5e", command_topic="/command")


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_empty_and_damaged_bags_are_refused(storage: StoragePlugin, tmp_path: Path):
    with pytest.raises(RecordingError, match="0 topics could carry the commands"):
        read_recording(write_bag(tmp_path / "empty", [], storage), "ur5e")
    path = write_bag(tmp_path / "bag", measured(short()) + commands(short(), ARRAY), storage)
    (file,) = (each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with pytest.raises(RecordingError, match=r"not a readable rosbag2 .*reindex"):
        read_recording(path, "ur5e")


def test_without_the_library_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write_bag(tmp_path / "bag", measured(short()) + commands(short(), ARRAY))
    monkeypatch.delitem(sys.modules, "pixel2catch.identification.rosbag", raising=False)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(RecordingError, match=r"needs rosbags.*pip install 'pixel2catch\[identification\]'"):
        read_recording(path, "ur5e")
