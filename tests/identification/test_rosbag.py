"""Bags written with rosbags, in both storages, and what makes one unusable."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import (
    ARRAY,
    JOINT_STATE,
    NANOSECOND,
    SHUFFLED,
    TRAJECTORY,
    TYPES,
    Message,
    array,
    commands,
    joint_state,
    measured,
    nanoseconds,
    trajectory,
    write_bag,
)
from recorded import ARM, assert_same, short
from rosbags.rosbag2 import StoragePlugin

from pixel2catch.errors import RecordingError
from pixel2catch.identification.importers import CommandTopic, Names, read_recording


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
    assert_same(
        read_recording(path, "ur5e", Names(command_topics=(CommandTopic(name="/command"),))),
        short(),
        NANOSECOND,
    )


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
        read_recording(path, "ur5e", Names(command_topics=(CommandTopic(name="/command"),)))


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
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(RecordingError, match=r"needs rosbags.*pip install .*\[identification\]"):
        read_recording(path, "ur5e")
