"""Bags of an arm and a hand: topics of their own, publishers of their own, a lab's names."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags import ARRAY, NANOSECOND, Message, array, commands, joint_state, nanoseconds, trajectory, write_bag
from recorded import ARM, ROBOTS, assert_same, short

from pixel2catch.errors import RecordingError
from pixel2catch.identification.importers import Names, read_recording
from pixel2catch.identification.recording import Recording
from pixel2catch.ros2.messages import read_float_array
from pixel2catch.ros2.profile import Profile
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FINGERS = ROBOTS["allegro"]
SPARE = ("spare_1", "spare_2", "spare_3")


def with_hand(recording: Recording) -> Recording:
    """The arm's motion with a hand whose joints copy the elbow's, a tenth as far."""
    arrays = {
        name: np.concatenate((values, np.repeat(0.1 * values[:, 2:3], len(FINGERS), axis=1)), axis=1)
        for name in ("q_cmd", "q")
        for values in (getattr(recording, name),)
    }
    return replace(recording, joints=ARM + FINGERS, qd=None, effort=None, **arrays)


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


def names_of(*topics: str) -> Names:
    return Names.parse(topics, "/joint_states", [])


HAND_TOPIC = f"/hand={','.join((*SPARE, *FINGERS))}"


def test_commands_of_two_topics_hold_on_their_own_clocks(tmp_path: Path):
    """At 0.1 s the arm gets its second command, the hand still has its first; at 0.15 s it has the second."""
    recording = with_hand(short())
    path = write_bag(tmp_path / "bag", states(recording, ARM + FINGERS) + two_topics(recording))
    got = read_recording(path, "ur5e_allegro", names_of("/arm", HAND_TOPIC))
    np.testing.assert_allclose(got.t_cmd, np.arange(10) * 0.05, atol=NANOSECOND)
    np.testing.assert_array_equal(got.q_cmd[:, :6], np.repeat(recording.q_cmd[:, :6], 2, axis=0))
    hand = np.concatenate((recording.q_cmd[:1], np.repeat(recording.q_cmd, 2, axis=0)))[:10, 6:]
    np.testing.assert_array_equal(got.q_cmd[:, 6:], hand)
    np.testing.assert_array_equal(got.q, recording.q)


def test_one_robots_part_is_read_from_two_topics(tmp_path: Path):
    """Of joint states by two publishers and commands on two topics, those of the joints asked for."""
    recording = with_hand(short())
    messages = states(recording, ARM) + states(recording, FINGERS, delay=0.01) + two_topics(recording)
    path = write_bag(tmp_path / "bag", messages)
    hand = read_recording(path, "allegro", names_of(HAND_TOPIC))
    np.testing.assert_array_equal(hand.q, recording.q[:, 6:])
    np.testing.assert_allclose(hand.t_meas[0] - hand.t_cmd[0], 0.02 + 0.01 - 0.05, atol=NANOSECOND)
    with pytest.raises(RecordingError, match="two publishers share the topic"):
        read_recording(path, "ur5e_allegro", names_of("/arm", HAND_TOPIC))


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        (("/arm",), "topic /arm: no joint index_joint_1, .*--rename"),
        (("/arm", "/hand"), "topic /hand, message 0: 16 numbers .* for 19 joints; .*TOPIC=JOINT"),
        (("/arm=ur5e", HAND_TOPIC), "topic /arm: its messages name the joints .*; leave out '=...'"),
        (("/arm", HAND_TOPIC.replace("spare_1", ARM[2])), "topic /arm, /hand: elbow_joint on more than one"),
        (("/arm", "/fist"), "no topic /fist; recorded are: /arm, /hand, /joint_states"),
    ],
)
def test_topics_that_do_not_fit_are_named(topics: tuple[str, ...], message: str, tmp_path: Path):
    recording = with_hand(short())
    path = write_bag(tmp_path / "bag", states(recording, ARM + FINGERS) + two_topics(recording))
    with pytest.raises(RecordingError, match=message):
        read_recording(path, "ur5e_allegro", names_of(*topics))


def test_a_labs_names_are_translated(tmp_path: Path):
    recording = replace(short(), qd=None, effort=None)
    theirs = [f"ur_{joint}" for joint in ARM]
    messages = [
        ("/lab/states", at, joint_state(at, theirs, message.position))
        for _, at, message in states(recording, ARM)
    ]
    renames = [f"{ours}={lab}" for ours, lab in zip(ARM, theirs, strict=True)]
    path = write_bag(tmp_path / "bag", messages + commands(recording, ARRAY))
    assert_same(read_recording(path, "ur5e", Names.parse([], "/lab/states", renames)), recording, NANOSECOND)


def test_a_profile_says_topics_and_names(tmp_path: Path):
    """Its hand begins with the thumb, and calls joints otherwise; three fingers' spread is none of ours."""
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
            sent = read_float_array(robot.command(target))
            messages.append((robot.command_topic.name, nanoseconds(time), array(sent)))
    path = write_bag(tmp_path / "bag", messages)
    read = read_recording(path, "ur5e_allegro", Names.of(profile, order))
    assert_same(read, part, 1e-6)


def test_joint_states_without_names_are_refused(tmp_path: Path):
    recording = short()
    messages = [
        ("/joint_states", nanoseconds(time), joint_state(nanoseconds(time), (), position))
        for time, position in zip(recording.t_meas, recording.q, strict=True)
    ]
    path = write_bag(tmp_path / "bag", messages + commands(recording, ARRAY))
    with pytest.raises(RecordingError, match=r"a joint state without names of joints.* fill in 'name'"):
        read_recording(path, "ur5e")


def test_pieces_of_a_bag_without_their_description_are_named(tmp_path: Path):
    for number in (0, 1):
        (tmp_path / f"run_{number}.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"run_0.mcap, run_1.mcap; .* need its metadata.yaml"):
        read_recording(tmp_path, "ur5e")


def test_a_bag_of_one_joint_is_read_if_that_will_do(tmp_path: Path):
    recording = short().select((ARM[2],))
    messages = []
    for time, position in zip(recording.t_meas, recording.q, strict=True):
        at = nanoseconds(time)
        messages.append(("/joint_states", at, joint_state(at, recording.joints, position)))
    for time, target in zip(recording.t_cmd, recording.q_cmd, strict=True):
        at = nanoseconds(time)
        messages.append(("/command", at, trajectory(at, recording.joints, target)))
    path = write_bag(tmp_path / "bag", messages)
    assert read_recording(path, "ur5e", is_partial=True).joints == (ARM[2],)
    with pytest.raises(RecordingError, match="no joint shoulder_pan_joint"):
        read_recording(path, "ur5e")
