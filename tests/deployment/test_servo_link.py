"""The link between control loop and servo: whole packets, no waiting, and an end that is seen."""

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from paper_robot import JOINTS
from pixel2catch.servo.link import Command, JointTargets, LoopEnd, ServoEnd, link

NUMBERS = np.linspace(-1.0, 1.0, len(JOINTS))


def joint_targets(stamp: float = 1.0) -> JointTargets:
    return JointTargets(
        joint_pos_target=NUMBERS,
        target_stamp=stamp,
        image_stamp=0.5,
        box_stamp=0.4,
        is_perception_sound=False,
        is_stop_requested=True,
    )


def command(time: float = 1.0) -> Command:
    return Command(
        time=time,
        mode=3,
        stopped_by=4,
        found=1 << 15,
        refused=6,
        clamped=7,
        joint_pos_command=np.full(len(JOINTS), np.nan),
        joint_pos=NUMBERS,
        duration=5e-4,
        target_stamp=time - 0.01,
        image_stamp=time - 0.02,
    )


@pytest.fixture
def ends() -> Iterator[tuple[LoopEnd, ServoEnd]]:
    loop, servo = link()
    with closing(loop), closing(servo):
        yield loop, servo


def test_orders_and_decisions_arrive_as_they_were_sent(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    loop.send(joint_targets())
    servo.send(command())
    (ordered,), (decided,) = servo.receive(), loop.receive()
    for sent, received in ((joint_targets(), ordered), (command(), decided)):
        for name, value in vars(sent).items():
            np.testing.assert_array_equal(getattr(received, name), value)
    assert not servo.receive()
    assert not servo.is_closed


def test_what_nobody_takes_is_dropped_and_counted(ends: tuple[LoopEnd, ServoEnd]):
    """At least 0.3 s of ticks fit; then the newest are lost, whole, and at once."""
    loop, servo = ends
    for tick in range(5000):
        servo.send(command(float(tick)))
    received = loop.receive()
    assert [each.time for each in received] == [float(tick) for tick in range(len(received))]
    assert len(received) > 150
    assert servo.num_dropped == 5000 - len(received)
    servo.send(command(9.0))
    assert loop.receive()[0].time == 9.0


def test_what_was_sent_before_the_end_is_received_and_then_the_end(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    loop.send(joint_targets())
    loop.close()
    assert len(servo.receive()) == 1
    assert servo.is_closed
    servo.send(command())
    assert servo.num_dropped == 1


def answer(end: ServoEnd) -> None:
    """A process that repeats what it is told, until it is killed."""
    while True:
        for order in end.receive():
            end.send(command(order.target_stamp))
        time.sleep(0.001)


def test_a_process_that_is_killed_is_seen_to_be_gone(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    process = multiprocessing.get_context("spawn").Process(target=answer, args=(servo,), daemon=True)
    process.start()
    servo.close()
    loop.send(joint_targets(7.0))
    received = []
    while not received:
        received = loop.receive()
        time.sleep(0.001)
    assert received[0].time == 7.0
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert not loop.receive()
    assert loop.is_closed
