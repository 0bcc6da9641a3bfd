"""Recordings: what others read from them, and what a bad disk or an interruption does."""

import resource
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from paper_robot import ARM_JOINTS, HAND_JOINTS, JOINTS
from pixel2catch.deployment import recorder
from pixel2catch.deployment.recorder import BagRecorder, DeploymentRecorder
from pixel2catch.deployment.stepped import StepClock
from pixel2catch.errors import DeploymentError, PerceptionError
from pixel2catch.identification.importers import Names, read_rosbag
from pixel2catch.ros2 import messages
from pixel2catch.ros2.bags import opened_bag
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import RealClock, Topic

NUMBER = Topic(name="/number", type=messages.NUMBER)
IMAGE = Topic(name="/image", type=messages.IMAGE)
MODE = Topic(name="/mode", type=messages.SAFETY_MODE, is_latched=True)
EPOCH = 1_790_000_000.0


def read(folder: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([folder]) as bag:
        return [(connection.topic, time, bytes(data)) for connection, time, data in bag.messages()]


def test_what_was_recorded_is_read_back_byte_by_byte(tmp_path: Path):
    pixels = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    sent = [
        (NUMBER, messages.number(1.0)),
        (IMAGE, messages.image(pixels, EPOCH)),
        (MODE, messages.safety_mode(3)),
    ]
    with BagRecorder(tmp_path / "throw") as bag:
        for i, (topic, data) in enumerate(sent):
            bag.record(topic, data, EPOCH + 0.25 * i)
    names, times, data = zip(*read(tmp_path / "throw"), strict=True)
    assert [*zip(names, data, strict=True)] == [(topic.name, data) for topic, data in sent]
    assert [round(1e-3 * (time - times[0])) for time in times] == [0, 250_000, 500_000]
    assert times[0] == round(EPOCH) * 10**9
    assert bag.num_written == {"/number": 1, "/image": 1, "/mode": 1}
    assert (bag.num_dropped, bag.problem) == ({}, "")


def test_a_recorded_throw_can_be_identified(tmp_path: Path):
    """The joint states and commands of a deployment, as they are on the wire, are what `identify` reads."""
    profile = Profile.load("ur5e_allegro_v4")
    time = np.arange(0.0, 3.0, 0.01)
    path = 0.2 * np.sin(2.0 * time)[:, None] + np.linspace(0.0, 1.0, len(JOINTS))
    wires = {theirs.name_in_state: joint for part in profile.robots for joint, theirs in part.joints.items()}
    order = [[joint.name for joint in JOINTS].index(joint) for joint in wires.values()]
    with BagRecorder(tmp_path / "throw") as bag:
        for moment, target in zip(EPOCH + time, path, strict=True):
            state = messages.joint_state(wires, 0.9 * target[order], moment)
            bag.record(profile.robots[0].state_topic, state, moment + 0.001)
            for part in profile.robots:
                bag.record(part.command_topic, part.command(target), moment + 0.0005)
    hand_topic = "/allegro_hand_position_controller/commands"
    order_of_hand = ",".join(["thumb_joint_0", "thumb_joint_1", "thumb_joint_2", "thumb_joint_3"])
    for finger, number in (("index", 1), ("middle", 2), ("ring", 3)):
        order_of_hand += f",ah_joint{number}0," + ",".join(f"{finger}_joint_{i}" for i in (1, 2, 3))
    renames = [f"{ours}={theirs}" for theirs, ours in wires.items() if ours != theirs]
    names = Names.parse(
        ["/forward_position_controller/commands=" + ",".join(joint.name for joint in ARM_JOINTS)],
        "/joint_states",
        renames,
    )
    arm = read_rosbag(tmp_path / "throw", tuple(joint.name for joint in ARM_JOINTS), names)
    np.testing.assert_allclose(arm.q_cmd, path[:, :6])
    np.testing.assert_allclose(arm.q, 0.9 * path[:, :6])
    in_their_names = order_of_hand
    for theirs, ours in wires.items():
        in_their_names = in_their_names.replace(ours, theirs)
    names = Names.parse([f"{hand_topic}={in_their_names}"], "/joint_states", renames)
    hand = read_rosbag(tmp_path / "throw", tuple(joint.name for joint in HAND_JOINTS), names)
    np.testing.assert_allclose(hand.q_cmd, path[:, 6:])
    np.testing.assert_allclose(hand.q, 0.9 * path[:, 6:])


def test_an_exception_leaves_a_whole_recording(tmp_path: Path):
    with suppress(KeyboardInterrupt), BagRecorder(tmp_path / "throw") as bag:
        bag.record(NUMBER, messages.number(1.0), EPOCH)
        raise KeyboardInterrupt
    assert len(read(tmp_path / "throw")) == 1


def test_what_was_there_is_not_overwritten(tmp_path: Path):
    with BagRecorder(tmp_path / "throw") as bag:
        bag.record(NUMBER, messages.number(1.0), EPOCH)
    with pytest.raises(DeploymentError, match=r"throw: no recording can be made .*choose another name"):
        BagRecorder(tmp_path / "throw")
    assert len(read(tmp_path / "throw")) == 1
    with pytest.raises(DeploymentError, match="no recording can be made"):
        BagRecorder(tmp_path / "throw" / "metadata.yaml" / "below")


def test_messages_of_several_threads_are_all_there(tmp_path: Path):
    with BagRecorder(tmp_path / "throw") as bag:

        def record(start: int) -> None:
            for i in range(start, start + 500):
                bag.record(NUMBER, messages.number(i), EPOCH + 0.001 * i)

        threads = [threading.Thread(target=record, args=[500 * i]) for i in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    values = [messages.read_number(data) for _, _, data in read(tmp_path / "throw")]
    assert sorted(values) == list(range(2000))


def test_what_does_not_fit_into_memory_is_dropped_and_counted(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(recorder, "MOST_WAITING", 100)
    with BagRecorder(tmp_path / "throw") as bag:
        bag.record(IMAGE, messages.image(np.zeros((48, 64, 3), np.uint8), EPOCH), EPOCH)
        bag.record(NUMBER, messages.number(1.0), EPOCH)
    assert bag.num_dropped == {"/image": 1}
    assert [topic for topic, *_ in read(tmp_path / "throw")] == ["/number"]


def test_a_full_disk_is_said_and_stops_nothing(tmp_path: Path):
    image = messages.image(np.zeros((480, 640, 3), np.uint8), EPOCH)
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**21, old[1]))
    try:
        with BagRecorder(tmp_path / "throw") as bag:
            for i in range(10):
                bag.record(IMAGE, image, EPOCH + i)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert "File too large" in bag.problem
    assert bag.num_dropped["/image"] > 0
    assert sum(bag.num_dropped.values()) + sum(bag.num_written.values()) == 10
    clock = RealClock()
    recording = DeploymentRecorder(
        bag, Broker().node(clock), Profile.load("ur5e_allegro_v4"), clock, images="raw"
    )
    with pytest.raises(DeploymentError, match=r"lacks [0-9]+ messages .*File too large.* record anew"):
        recording.require_whole()


def test_a_recording_of_a_program_that_was_held_up_may_lack_messages(tmp_path: Path):
    """Before its first look nothing was to be recorded."""
    clock = StepClock(lambda _: None)
    with BagRecorder(tmp_path / "throw") as bag:
        profile, node = Profile.load("ur5e_allegro_v4"), Broker().node(clock)
        recording = DeploymentRecorder(bag, node, profile, clock, images="none")
        for moment in (3.0, 3.4, 3.8):
            clock.time = moment
            recording.record_messages()
            recording.require_whole()
        clock.time = 4.4
        recording.record_messages()
        with pytest.raises(DeploymentError, match="was held up: end others, and record anew"):
            recording.require_whole()


def test_after_a_kill_all_but_the_last_chunk_is_on_the_disk(tmp_path: Path):
    script = """
import sys, time, numpy as np
from pathlib import Path
from pixel2catch.ros2 import messages
from pixel2catch.deployment.recorder import BagRecorder
from pixel2catch.ros2.transport import Topic
bag = BagRecorder(Path(sys.argv[1]))
image = messages.image(np.zeros((480, 640, 3), np.uint8), 1.0)
for i in range(10):
    bag.record(Topic(name="/image", type=messages.IMAGE), image, 1.0 + i)
while bag.num_written["/image"] < 10:
    time.sleep(0.01)
print("written", flush=True)
sys.stdin.read()
"""
    command = [sys.executable, "-c", script, str(tmp_path / "throw")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stdout.readline() == "written\n"
        process.kill()
    (file,) = (tmp_path / "throw").iterdir()
    assert file.stat().st_size > 9 * 480 * 640 * 3
    with pytest.raises(PerceptionError, match="'mcap recover' for a file that was cut off"), opened_bag(file):
        pass
