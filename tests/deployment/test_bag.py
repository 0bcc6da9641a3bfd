"""A recording played as a network."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.recorder import BagRecorder
from pixel2catch.deployment.replay import BagPlayer
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.messages import compress, compressed_topic
from pixel2catch.ros2.transport import Topic

NUMBER = Topic(name="/number", type=messages.NUMBER)
STATES = Topic(name="/joint_states", type=messages.JOINT_STATE)
IMAGE = Topic(name="/image", type=messages.IMAGE)
EPOCH = 1_790_000_000.0
PERIOD, TICK = 0.1, 0.002


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


def played(folder: Path, topic: Topic, reader: Callable[[bytes], Any]) -> list[tuple[float, Any]]:
    """Return the arrival and the content of each message of a topic."""
    clock, broker = StepClock(lambda _: None), Broker()
    subscription, received = broker.node(clock).subscription(topic, 10), []
    with BagPlayer(folder, broker.node(clock), {topic}) as player:
        clock.time = player.start
        while not player.is_over:
            player.play(clock.time)
            received += [(message.arrival, reader(message.data)) for message in subscription.take()]
            clock.time += TICK
    return received


def test_messages_are_played_in_order_and_time(folder: Path):
    arrivals, values = zip(*played(folder, NUMBER, messages.read_number), strict=True)
    assert values == (0.0, 1.0, 2.0)
    np.testing.assert_allclose(np.diff(arrivals), PERIOD, atol=TICK + 1e-6)


@pytest.mark.parametrize(
    ("topic", "stamp"),
    [
        (STATES, lambda data: messages.read_joint_state(data).stamp),
        (IMAGE, lambda data: messages.read_image(data).stamp),
    ],
)
def test_stamps_keep_their_age(folder: Path, topic: Topic, stamp):
    ages = [arrival - stamp for arrival, stamp in played(folder, topic, stamp)]
    assert len(ages) == 3
    assert 0.01 - 1e-6 <= min(ages) <= max(ages) <= 0.01 + TICK + 1e-6


def test_jpeg_images_are_played_as_raw_ones(tmp_path: Path):
    """A damaged one is left out."""
    pixels = np.full((48, 64, 3), (200, 30, 20), dtype=np.uint8)
    with BagRecorder(tmp_path / "throw") as bag:
        for data in (messages.image(pixels, EPOCH), b"\x00\x01\x00\x00", messages.image(pixels, EPOCH + 1)):
            bag.record(compressed_topic(IMAGE), data, EPOCH, compress)
        bag.record(compressed_topic(IMAGE), b"\x00\x01\x00\x00nonsense", EPOCH)
    assert bag.num_written == {"/image/compressed": 3}
    assert bag.num_dropped == {"/image/compressed": 1}
    readings = [reading for _, reading in played(tmp_path / "throw", IMAGE, messages.read_image)]
    assert len(readings) == 2
    assert readings[1].stamp - readings[0].stamp == pytest.approx(1.0)
    assert np.abs(readings[0].pixels.astype(int) - pixels).max() < 8
