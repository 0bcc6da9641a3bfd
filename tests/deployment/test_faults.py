"""A whole deployment in a laboratory in which things go wrong, in stepped time."""

from collections.abc import Iterator
from random import Random

import numpy as np
import pytest
from camera_lab import SteppedBench
from loop_lab import PROFILE
from servo_rows import LIMITS

from mutation import changed_bytes
from pixel2catch.deployment.perception import NUM_EQUAL
from pixel2catch.deployment.policy_pipeline import FADE_STEPS
from pixel2catch.ros2 import messages
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.servo.limits import LOSS_TIME, STOP_TIME

NUM_CHANGES = 6  #: Of a message of each topic.


def speed(bench: SteppedBench, seconds: float) -> float:
    """Speed of the arm's commands for some time [rad/s]."""
    num = len(bench.commands)
    bench.wait(seconds)
    change = np.abs(np.diff([command for _, command in bench.commands[num:]], axis=0)).max(axis=1)
    return float(change.mean()) / LIMITS.dt


def require_standstill(bench: SteppedBench, since: float) -> None:
    bench.wait_until(since + STOP_TIME)
    late = [command for arrival, command in bench.commands if arrival > since]
    assert len(late) > 10
    assert not np.diff(late, axis=0).any()


@pytest.fixture
def bench() -> Iterator[SteppedBench]:
    """At the end, no command was beyond a limit."""
    with SteppedBench() as bench:
        yield bench
    arm, commands = PROFILE.robots[0].ids, np.array([command for _, command in bench.commands])
    assert len(commands) > 50
    assert (commands >= LIMITS.joints.lower[arm] - 1e-9).all()
    assert (commands <= LIMITS.joints.upper[arm] + 1e-9).all()


def test_a_fault_of_the_images_stops_the_robot_until_it_is_armed_again(bench: SteppedBench):
    """`test_servo_faults` has the faults that the servo finds in its own inputs."""
    bench.run()
    lab = bench.lab
    for break_it, reason in (
        (lambda: lab.silent.add("camera"), "image stale"),
        (lambda: setattr(lab, "jump", 180.0), "perception unsound"),
    ):
        break_it()
        bench.until(lambda: bench.status["mode"] == "stopped")
        assert bench.status["stopped_by"] == [reason]
        require_standstill(bench, bench.clock.time + STOP_TIME)
        bench.run()
    bench.lab.frozen = bench.lab.picture()
    begin = bench.clock.time
    bench.until(lambda: bench.status["mode"] == "stopped")
    assert bench.status["stopped_by"] == ["perception unsound"]
    assert bench.clock.time - begin < (NUM_EQUAL + 2) * CONTROL_DT
    assert "is frozen" in bench.status["message"]


def test_no_message_on_any_topic_ends_it(bench: SteppedBench):
    """Each is changed at random and received by servo and control loop; then the robot can be armed again."""
    others, info = bench.broker.node(bench.clock), PROFILE.camera.info
    assert info is not None
    others.publisher(info).publish(messages.camera_info(RGB_CAMERA, 0.0))
    others.publisher(PROFILE.operator.stop).publish(messages.boolean(False))
    bench.run()
    valid = [(each, each.last) for each in (*bench.lab_node.publishers, *others.publishers) if each.last]
    assert len({each.topic.type for each, _ in valid}) == 9
    random = Random(0)
    for publisher, good in NUM_CHANGES * valid:
        publisher.publish(changed_bytes(good, random))
        bench.wait(LIMITS.dt)
        publisher.publish(good)
    bench.run()


def test_a_hidden_object_is_waited_for_at_rest_and_lost_after_a_while(bench: SteppedBench):
    """Seen again in time, the policy goes on; later, the robot has to be armed again."""
    bench.run()
    assert bench.status["object"] == "seen"
    bench.lab.is_object_there = False
    bench.until(lambda: bench.status["object"] == "searching")
    bench.wait((FADE_STEPS + 3) * CONTROL_DT)
    assert speed(bench, 0.3) < 1e-6
    bench.lab.mend()
    bench.until(lambda: bench.status["object"] == "seen")
    assert speed(bench, 0.3) > 1e-3
    assert bench.status["mode"] == "run"
    bench.lab.is_object_there = False
    begin = bench.clock.time
    bench.until(lambda: bench.status["mode"] == "stopped", 2.0 * LOSS_TIME)
    assert bench.clock.time - begin == pytest.approx(LOSS_TIME, abs=0.2)
    assert (bench.status["stopped_by"], bench.status["object"]) == (["object lost"], "lost")
    bench.lab.mend()
    bench.until(lambda: bench.status["object"] == "seen")
    bench.wait(0.2)
    assert bench.status["mode"] == "stopped"
