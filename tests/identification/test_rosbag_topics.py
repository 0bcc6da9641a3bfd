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
