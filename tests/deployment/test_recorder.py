"""Recordings: what is written, and what a bad disk or an interruption does."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from domains import full_disk
from pixel2catch.deployment import recorder
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.recorder import BagRecorder, DeploymentRecorder
from pixel2catch.errors import DeploymentError, PerceptionError
from pixel2catch.interruption import raise_on_termination
from pixel2catch.ros2 import messages
from pixel2catch.ros2.bags import opened_bag
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, RealClock, Topic

NUMBER = Topic(name="/number", type=messages.NUMBER)
IMAGE = Topic(name="/image", type=messages.IMAGE)
MODE = Topic(name="/mode", type=messages.SAFETY_MODE, is_latched=True)
EPOCH = 1_790_000_000.0


def read(folder: Path) -> list[tuple[str, int, bytes]]:
    with opened_bag(folder) as bag:
        return [(connection.topic, time, bytes(data)) for connection, time, data in bag.messages()]


def test_what_was_recorded_is_read_back_byte_by_byte(tmp_path: Path):
    """After an exception, too."""
    pixels = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    image = messages.image(pixels, EPOCH)
    sent = [(NUMBER, messages.number(1.0)), (IMAGE, image), (MODE, messages.safety_mode(3))]
    with suppress(KeyboardInterrupt), BagRecorder(tmp_path / "throw") as bag:
        for i, (topic, data) in enumerate(sent):
            bag.record(topic, data, EPOCH + 0.25 * i)
        raise KeyboardInterrupt
    names, times, data = zip(*read(tmp_path / "throw"), strict=True)
    assert [*zip(names, data, strict=True)] == [(topic.name, data) for topic, data in sent]
    assert [round(1e-3 * (time - times[0])) for time in times] == [0, 250_000, 500_000]
    assert times[0] == round(EPOCH) * 10**9
    assert bag.num_written == {"/number": 1, "/image": 1, "/mode": 1}
    assert (bag.num_dropped, bag.problem) == ({}, "")


def test_an_existing_recording_is_not_overwritten(tmp_path: Path):
    with BagRecorder(tmp_path / "throw") as bag:
        bag.record(NUMBER, messages.number(1.0), EPOCH)
    with pytest.raises(DeploymentError, match=r"throw: no recording .*choose another name"):
        BagRecorder(tmp_path / "throw")
    assert len(read(tmp_path / "throw")) == 1
    with pytest.raises(DeploymentError, match="no recording"):
        BagRecorder(tmp_path / "throw" / "metadata.yaml" / "below")


@pytest.mark.parametrize(("is_full", "words"), [(True, "lacks 1 m"), (False, "lacks 1 m.*no image")])
def test_a_message_beyond_the_memory_or_in_error_is_counted_and_no_other_is_lost(
    is_full: bool, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def convert(data: bytes) -> bytes:
        if not is_full:
            raise ValueError("no image")
        return data

    monkeypatch.setattr(recorder, "MOST_WAITING", 100)
    with BagRecorder(tmp_path / "throw") as bag:
        bag.record(IMAGE, bytes(200 * is_full), EPOCH, convert)
        bag.record(NUMBER, messages.number(1.0), EPOCH)
    assert bag.num_dropped == {"/image": 1}
    assert [topic for topic, *_ in read(tmp_path / "throw")] == ["/number"]
    with pytest.raises(DeploymentError, match=words):
        recording_with(bag).require_whole()


def recording_with(bag: BagRecorder, clock: Clock | None = None) -> DeploymentRecorder:
    clock, profile = clock or RealClock(), Profile.load("ur5e_allegro_v4")
    return DeploymentRecorder(bag, Broker().node(clock), profile, clock, images="raw")


def test_a_full_disk_is_reported_and_stops_nothing(tmp_path: Path):
    image = messages.image(np.zeros((480, 640, 3), np.uint8), EPOCH)
    with full_disk(2**21), BagRecorder(tmp_path / "throw") as bag:
        for i in range(10):
            bag.record(IMAGE, image, EPOCH + i)
    assert "File too large" in bag.problem
    assert bag.num_dropped["/image"] > 0
    assert sum(bag.num_dropped.values()) + sum(bag.num_written.values()) == 10
    with pytest.raises(DeploymentError, match=r"lacks [0-9]+ messages .*File too large"):
        recording_with(bag).require_whole()


def test_a_recording_of_a_program_that_was_suspended_may_lack_messages(tmp_path: Path):
    clock = StepClock(lambda _: None)
    with BagRecorder(tmp_path / "throw") as bag:
        recording = recording_with(bag, clock)
        for moment in (3.0, 3.4, 3.8):
            clock.time = moment
            recording.record_messages()
            recording.require_whole()
        clock.time = 4.4
        recording.record_messages()
        with pytest.raises(DeploymentError, match="was delayed"):
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_recording_is_completed_leaves_it_readable(tmp_path: Path, number: int):
    """What still waits is dropped and reported; the file has its metadata."""

    def interrupt(data: bytes) -> bytes:
        while signal.getsignal(number) != bag._hurry:  # the recording is not being completed yet
            time.sleep(0.001)
        while not bag._is_hurried:  # a signal just before the main thread waits does not end its wait
            os.kill(os.getpid(), number)
            time.sleep(0.001)
        return data

    with raise_on_termination(), BagRecorder(tmp_path / "throw") as bag:
        for i, convert in enumerate((bytes, interrupt, bytes)):
            bag.record(NUMBER, messages.number(i), EPOCH + i, convert)
    assert len(read(tmp_path / "throw")) == 2
    assert (tmp_path / "throw" / "metadata.yaml").exists()
    with pytest.raises(DeploymentError, match="lacks 1 messages"):
        recording_with(bag).require_whole()
