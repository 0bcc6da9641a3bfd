"""A recording played as a network."""

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixel2catch.deployment.recorder import BagRecorder
from pixel2catch.deployment.replay import ReplayTransport
from pixel2catch.deployment.stepped import StepClock
from pixel2catch.errors import PerceptionError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import compress, compressed_topic
from pixel2catch.ros2.transport import RealClock, Subscription, Topic

NUMBER = Topic(name="/number", type=messages.NUMBER)
STATES = Topic(name="/joint_states", type=messages.JOINT_STATE)
IMAGE = Topic(name="/image", type=messages.IMAGE)
EPOCH = 1_790_000_000.0
PERIOD = 0.1


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three numbers, joint states and images, a period apart; stamps are 10 ms older than the messages."""
    pixels = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    with BagRecorder(tmp_path / "throw") as bag:
        for i in range(3):
            moment = EPOCH + PERIOD * i
            bag.record(NUMBER, messages.number(i), moment)
            bag.record(STATES, messages.joint_state(["a"], [i], moment - 0.01), moment)
            bag.record(IMAGE, messages.image(pixels, moment - 0.01), moment)
    return tmp_path / "throw"


def play(
    node: ReplayTransport, subscription: Subscription, reader: Callable[[bytes], Any]
) -> list[tuple[float, Any]]:
    """When each message arrived, and what the reader makes of it."""
    received = []
    while not (node.is_over and not node.wait(0.0)):
        node.wait(0.02)
        received += [(message.arrival, reader(message.data)) for message in subscription.take()]
    return received


def stepped() -> StepClock:
    """Time that passes while somebody waits."""
    clock = StepClock(lambda moment: setattr(clock, "time", moment))
    return clock


def test_messages_come_in_their_order_at_their_time(folder: Path):
    with closing(ReplayTransport(folder, stepped())) as node:
        arrivals, values = zip(*play(node, node.subscription(NUMBER, 10), messages.read_number), strict=True)
    assert values == (0.0, 1.0, 2.0)
    np.testing.assert_allclose(np.diff(arrivals), PERIOD, atol=1e-6)


def test_a_recording_takes_as_long_as_it_took_by_the_clocks_rate(folder: Path):
    begin = time.perf_counter()
    with closing(ReplayTransport(folder, RealClock(0.5))) as node:
        play(node, node.subscription(NUMBER, 10), messages.read_number)
    assert 0.5 * (time.perf_counter() - begin) >= 2.0 * PERIOD


@pytest.mark.parametrize(
    ("topic", "stamp"),
    [
        (STATES, lambda data: messages.read_joint_state(data).stamp),
        (IMAGE, lambda data: messages.read_image(data).stamp),
    ],
)
def test_stamps_are_as_old_as_they_were(folder: Path, topic: Topic, stamp):
    clock = stepped()
    with closing(ReplayTransport(folder, clock)) as node:
        received = play(node, node.subscription(topic, 10), stamp)
    ages = [arrival - (stamp - clock.stamp() + clock.now()) for arrival, stamp in received]
    assert len(ages) == 3
    np.testing.assert_allclose(ages, 0.01, atol=1e-6)


def test_jpeg_images_come_as_raw_ones(tmp_path: Path):
    """And one that is damaged does not come."""
    pixels = np.full((48, 64, 3), (200, 30, 20), dtype=np.uint8)
    with BagRecorder(tmp_path / "throw") as bag:
        for data in (messages.image(pixels, EPOCH), b"\x00\x01\x00\x00", messages.image(pixels, EPOCH + 1)):
            bag.record(compressed_topic(IMAGE), data, EPOCH, compress)
        bag.record(compressed_topic(IMAGE), b"\x00\x01\x00\x00nonsense", EPOCH)
    assert bag.num_written == {"/image/compressed": 3}
    assert bag.num_dropped == {"/image/compressed": 1}
    with closing(ReplayTransport(tmp_path / "throw", stepped())) as node:
        readings = [reading for _, reading in play(node, node.subscription(IMAGE, 10), messages.read_image)]
    assert len(readings) == 2
    assert readings[1].stamp - readings[0].stamp == pytest.approx(1.0)
    assert np.abs(readings[0].pixels.astype(int) - pixels).max() < 8


def test_nothing_comes_before_somebody_looks_and_nothing_is_sent(folder: Path):
    with closing(ReplayTransport(folder, RealClock())) as node:
        subscription = node.subscription(NUMBER, depth=10)
        assert node.num_other_publishers(NUMBER) == 0
        node.publisher(NUMBER).publish(messages.number(9.0))
        time.sleep(1.5 * PERIOD)
        assert node.wait(1.0)
        assert messages.read_number(subscription.take()[0].data) == 0.0


def test_a_replay_that_is_closed_ends_at_once(folder: Path):
    node = ReplayTransport(folder, RealClock(0.001))
    node.subscription(NUMBER).take()
    begin = time.perf_counter()
    node.close()
    assert time.perf_counter() - begin < 60.0


def test_what_is_no_recording_is_refused(tmp_path: Path):
    with pytest.raises(PerceptionError, match="not a readable rosbag2"):
        ReplayTransport(tmp_path / "gone", RealClock())
