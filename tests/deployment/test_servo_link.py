"""The link between control loop and servo: whole packets, no waiting, closed ends."""

from dataclasses import replace

import numpy as np
from loop_lab import command

from paper_robot import JOINTS
from pixel2catch.servo.link import JointTargets, LoopEnd, Mode, ServoEnd

NUMBERS = np.linspace(-1.0, 1.0, len(JOINTS))
TARGETS = JointTargets(
    joint_pos_target=NUMBERS,
    target_stamp=1.0,
    image_stamp=0.5,
    box_stamp=0.4,
    is_perception_sound=False,
    is_stop_requested=True,
)
COMMAND = replace(
    command(
        Mode.RUN, time=1.0, joint_pos=NUMBERS, stopped_by=4, refused=6, target_stamp=0.99, image_stamp=0.98
    ),
    found=1 << 15,
    clamped=7,
    joint_pos_command=np.full(len(JOINTS), np.nan),
)


def test_targets_and_commands_arrive_unchanged(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    loop.send(TARGETS)
    servo.send(COMMAND)
    (ordered,), (decided,) = servo.receive(), loop.receive()
    for sent, received in ((TARGETS, ordered), (COMMAND, decided)):
        for name, value in vars(sent).items():
            np.testing.assert_array_equal(getattr(received, name), value)
    assert not servo.receive()
    assert not servo.is_closed


def test_packets_that_do_not_fit_are_dropped_and_counted(ends: tuple[LoopEnd, ServoEnd]):
    """At least 0.3 s of ticks fit; newer packets are lost."""
    loop, servo = ends
    for tick in range(5000):
        servo.send(replace(COMMAND, time=float(tick)))
    received = loop.receive()
    assert [each.time for each in received] == [float(tick) for tick in range(len(received))]
    assert len(received) > 150
    assert servo.num_dropped == 5000 - len(received)
    servo.send(replace(COMMAND, time=9.0))
    assert loop.receive()[0].time == 9.0


def test_packets_from_before_the_end_are_received(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    loop.send(TARGETS)
    loop.close()
    assert len(servo.receive()) == 1
    assert servo.is_closed
    servo.send(COMMAND)
    assert servo.num_dropped == 1
