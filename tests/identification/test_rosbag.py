"""Bags of an arm and a hand in both storages, and what makes one unusable."""

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
    Message,
    array,
    commands,
    joint_state,
    measured,
    nanoseconds,
    trajectory,
    write_bag,
)
from recorded import ARM, ROBOTS, assert_same, short
from rosbags.rosbag2 import StoragePlugin

from pixel2catch.errors import RecordingError
from pixel2catch.identification.importers import RecordedNames, read_rosbag
from pixel2catch.identification.recording import Recording
from pixel2catch.ros2.messages import read_float_array
from pixel2catch.ros2.profile import Profile
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FINGERS = ROBOTS["allegro"]
ALL = ARM + FINGERS


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_bag_keeps_both_clocks(storage: StoragePlugin, tmp_path: Path):
    """Stamps count, not receive times, in any order of joints; from the folder or the file."""
    for kind in (JOINT_STATE, TRAJECTORY, ARRAY):
        path = write_bag(
            tmp_path / kind.replace("/", "."), measured(short()) + commands(short(), kind), storage
        )
        assert_same(read_rosbag(path, ARM), short(), NANOSECOND)
        (file,) = (each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
        assert_same(read_rosbag(file, ARM), short(), NANOSECOND)


def test_one_of_several_command_topics_is_chosen_by_name(tmp_path: Path):
    other = [("/other", nanoseconds(0.1), array(np.zeros(13)))]
    path = write_bag(tmp_path / "bag", measured(short()) + commands(short(), ARRAY) + other)
    with pytest.raises(RecordingError, match=r"2 topics could .* \(/command, /other\); .* --command-topic"):
        read_rosbag(path, ARM)
    assert_same(read_rosbag(path, ARM, RecordedNames(command_topics={"/command": ()})), short(), NANOSECOND)


def one_state(*args: Any) -> list[Message]:
    """Joint states whose third message is made of these arguments."""
    messages = measured(short())
    return [*messages[:2], (*messages[2][:2], joint_state(nanoseconds(0.1), *args)), *messages[3:]]


NAMES = [*(ARM[i] for i in SHUFFLED), "gripper_joint"]
SWAPPED = [*measured(short())[:4], *measured(short(), order=[0, 1, 2, 3, 4, 5])[4:]]
SENT = commands(short(), TRAJECTORY)
PLAN = [("/command", nanoseconds(0.6), trajectory(nanoseconds(0.6), ARM, np.ones(6), np.ones(6)))]
WIDE = [("/command", nanoseconds(0.1), array(np.zeros(13)))]
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
        (UNNAMED + SENT, "a joint state without names of joints.* fill in 'name'"),
        (measured(short()) + WIDE, "topic /command, message 0: 13 positions for 6 joints"),
    ],
)
def test_error_names_topic_message_and_fix(messages: list[Message], message: str, tmp_path: Path):
    path = write_bag(tmp_path / "bag", messages)
    with pytest.raises(RecordingError, match=message) as caught:
        read_rosbag(path, ARM)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_damaged_bag_is_refused(storage: StoragePlugin, tmp_path: Path):
    path = write_bag(tmp_path / "bag", measured(short()) + SENT, storage)
    (file,) = (each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with pytest.raises(RecordingError, match=r"not a readable rosbag2 .*reindex"):
        read_rosbag(path, ARM)


def test_other_files_and_a_missing_library_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(RecordingError, match=r"notes\.txt: not a recording; give an \.npz file"):
        read_rosbag(tmp_path / "notes.txt", ARM)
    path = write_bag(tmp_path / "bag", measured(short()) + SENT)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(RecordingError, match=r"needs rosbags.*pip install .*\[identification\]"):
        read_rosbag(path, ARM)


def with_hand(recording: Recording) -> Recording:
    """The arm's motion with a hand whose joints copy the elbow's, a tenth as far."""
    arrays = {
        name: np.concatenate((values, np.repeat(0.1 * values[:, 2:3], len(FINGERS), axis=1)), axis=1)
        for name in ("q_cmd", "q")
        for values in (getattr(recording, name),)
    }
    return replace(recording, joints=ALL, **arrays)


def states(recording: Recording, joints: tuple[str, ...], delay: float = 0.0) -> list[Message]:
    """Joint states of some joints alone, as a publisher of its own sends them."""
    part = recording.select(joints)
    times = [nanoseconds(time + delay) for time in part.t_meas]
    return [
        ("/joint_states", at, joint_state(at, joints, position))
        for at, position in zip(times, part.q, strict=True)
    ]


def two_topics(recording: Recording) -> list[Message]:
    """The arm's commands as trajectories, and 50 ms later the hand's, as 16 numbers without names."""
    arm, hand = recording.select(ARM), recording.select(FINGERS)
    messages = []
    for time, targets, fingers in zip(recording.t_cmd, arm.q_cmd, hand.q_cmd, strict=True):
        at, later = nanoseconds(time), nanoseconds(time + 0.05)
        messages.append(("/arm", at, trajectory(at, ARM, targets)))
        messages.append(("/hand", later, array(np.concatenate((np.full(3, 0.9), fingers)))))
    return messages


SPARE = ("spare_1", "spare_2", "spare_3")
BOTH = {"/arm": (), "/hand": (*SPARE, *FINGERS)}


def test_commands_of_two_topics_hold_on_their_own_clocks(tmp_path: Path):
    """At 0.1 s the arm gets its second command, the hand still has its first; at 0.15 s it has the second."""
    recording = with_hand(short())
    path = write_bag(tmp_path / "bag", states(recording, ALL) + two_topics(recording))
    got = read_rosbag(path, ALL, RecordedNames(command_topics=BOTH))
    np.testing.assert_allclose(got.t_cmd, np.arange(10) * 0.05, atol=NANOSECOND)
    np.testing.assert_array_equal(got.q_cmd[:, :6], np.repeat(recording.q_cmd[:, :6], 2, axis=0))
    hand = np.concatenate((recording.q_cmd[:1], np.repeat(recording.q_cmd, 2, axis=0)))[:10, 6:]
    np.testing.assert_array_equal(got.q_cmd[:, 6:], hand)
    np.testing.assert_array_equal(got.q, recording.q)


def test_one_part_is_read_from_topics_of_two_publishers(tmp_path: Path):
    recording = with_hand(short())
    messages = states(recording, ARM) + states(recording, FINGERS, delay=0.01) + two_topics(recording)
    path = write_bag(tmp_path / "bag", messages)
    hand = read_rosbag(path, FINGERS, RecordedNames(command_topics={"/hand": BOTH["/hand"]}))
    np.testing.assert_array_equal(hand.q, recording.q[:, 6:])
    np.testing.assert_allclose(hand.t_meas[0] - hand.t_cmd[0], 0.02 + 0.01 - 0.05, atol=NANOSECOND)
    with pytest.raises(RecordingError, match="two publishers share the topic"):
        read_rosbag(path, ALL, RecordedNames(command_topics=BOTH))


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        ({"/arm": ()}, "topic /arm: no joint index_joint_1, .*--profile"),
        ({"/arm": (), "/hand": ("spare", *ARM[1:3], *FINGERS)}, "topic /arm, /hand: elbow_joint, .* several"),
    ],
)
def test_topics_that_do_not_fit_are_named(topics: dict[str, tuple[str, ...]], message: str, tmp_path: Path):
    recording = with_hand(short())
    path = write_bag(tmp_path / "bag", states(recording, ALL) + two_topics(recording))
    with pytest.raises(RecordingError, match=message):
        read_rosbag(path, ALL, RecordedNames(command_topics=topics))


def test_a_name_of_ours_on_another_joint_is_not_taken_for_ours():
    names = RecordedNames(
        joints={"wrist_1_joint": "elbow_joint", "elbow_joint": "wrist_1_joint", "e": "wrist_2_joint"}
    )
    recorded = ("elbow_joint", "wrist_1_joint", "e", "wrist_2_joint")
    assert names.renamed(recorded)[:3] == ("wrist_1_joint", "elbow_joint", "wrist_2_joint")
    assert names.renamed(recorded)[3] != "wrist_2_joint"


def test_a_profile_has_topics_and_names(tmp_path: Path):
    """Its hand begins with the thumb and has other names; three joints of its fingers are held."""
    profile = Profile.load("ur5e_allegro_v4")
    recording = with_hand(short())
    names = [theirs.name_in_state for part in profile.robots for theirs in part.joints.values()]
    ours = [joint for part in profile.robots for joint in part.joints]
    part = recording.select(tuple(joint for joint in recording.joints if joint in ours))
    columns = [part.joints.index(joint) for joint in ours]
    messages = []
    for time, row in zip(part.t_meas, part.q, strict=True):
        at = nanoseconds(time)
        messages.append(("/joint_states", at, joint_state(at, names, row[columns])))
    order = [joint.name for joint in UR5E_ALLEGRO.joints]
    for time, row in zip(part.t_cmd, part.q_cmd, strict=True):
        target = np.array([row[part.joints.index(joint)] for joint in order])
        for robot in profile.robots:
            sent = read_float_array(robot.command(target, robot.held_angles))
            messages.append((robot.command_topic.name, nanoseconds(time), array(sent)))
    path = write_bag(tmp_path / "bag", messages)
    assert_same(read_rosbag(path, ALL, RecordedNames.of(profile, order)), part, 1e-6)


def test_a_bag_of_one_joint_is_read(tmp_path: Path):
    recording = short().select((ARM[2],))
    sent = [
        ("/command", nanoseconds(time), trajectory(nanoseconds(time), recording.joints, target))
        for time, target in zip(recording.t_cmd, recording.q_cmd, strict=True)
    ]
    path = write_bag(tmp_path / "bag", states(recording, recording.joints) + sent)
    assert_same(read_rosbag(path, ARM), recording, NANOSECOND)
    with pytest.raises(RecordingError, match="no joint index_joint_1"):
        read_rosbag(path, FINGERS)
