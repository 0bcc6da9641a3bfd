"""The link between control loop and servo: whole packets, no waiting, closed ends."""

import numpy as np

from paper_robot import JOINTS
from pixel2catch.servo.link import Command, JointTargets, LoopEnd, ServoEnd

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


def test_targets_and_commands_arrive_unchanged(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    loop.send(joint_targets())
    servo.send(command())
    (ordered,), (decided,) = servo.receive(), loop.receive()
    for sent, received in ((joint_targets(), ordered), (command(), decided)):
        for name, value in vars(sent).items():
            np.testing.assert_array_equal(getattr(received, name), value)
    assert not servo.receive()
    assert not servo.is_closed


def test_packets_that_do_not_fit_are_dropped_and_counted(ends: tuple[LoopEnd, ServoEnd]):
    """At least 0.3 s of ticks fit; newer packets are lost."""
    loop, servo = ends
    for tick in range(5000):
        servo.send(command(float(tick)))
    received = loop.receive()
    assert [each.time for each in received] == [float(tick) for tick in range(len(received))]
    assert len(received) > 150
    assert servo.num_dropped == 5000 - len(received)
    servo.send(command(9.0))
    assert loop.receive()[0].time == 9.0


def test_packets_from_before_the_end_are_received(ends: tuple[LoopEnd, ServoEnd]):
    loop, servo = ends
    loop.send(joint_targets())
    loop.close()
    assert len(servo.receive()) == 1
    assert servo.is_closed
    servo.send(command())
    assert servo.num_dropped == 1
