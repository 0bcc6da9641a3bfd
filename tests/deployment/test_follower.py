"""A trajectory on its way to the servo: from arming on, once, and not after a stop."""

import re
from pathlib import Path

import numpy as np
import pytest
from loop_lab import HOME, badly_recorded, command, surroundings

from pixel2catch.deployment.follower import TrajectoryFollower
from pixel2catch.errors import DeploymentError
from pixel2catch.servo.link import Fault, JointTargets, Mode
from pixel2catch.servo.status_words import sentence

RAMP = 0.05


def ramp(time: float) -> np.ndarray:
    return HOME + np.clip(time, 0.0, 0.1)


def test_targets_are_those_of_the_time_since_the_ramp():
    with surroundings() as around:
        follower, received = TrajectoryFollower(ramp, 0.15, RAMP, around.connection), list[JointTargets]()
        armed_at = around.clock.now()
        around.servo.send(command(Mode.ARMED, time=armed_at))
        follower.run(lambda: False, lambda _: received.extend(around.servo.receive()))
        assert follower.is_done
        assert len(received) > 10
        for targets in received:
            expected = ramp(targets.target_stamp - armed_at - RAMP)
            assert targets.joint_pos_target == pytest.approx(expected, abs=1e-9)
        (last,) = around.servo.receive()
        assert last.is_stop_requested


def test_no_target_is_sent_before_arming():
    with surroundings() as around:
        follower, num_calls = TrajectoryFollower(ramp, 0.1, RAMP, around.connection), 0

        def count(_: object) -> None:
            nonlocal num_calls
            num_calls += 1

        around.servo.send(command(Mode.IDLE, time=around.clock.now()))
        follower.run(lambda: num_calls > 3, count)
        assert around.servo.receive() == []
        assert not follower.is_done


def test_an_incomplete_recording_is_reported_while_it_follows(tmp_path: Path):
    with badly_recorded(tmp_path) as around:
        follower, lines = TrajectoryFollower(ramp, 0.15, RAMP, around.connection), list[str]()
        around.servo.send(command(Mode.RUN, time=around.clock.now()))
        follower.run(lambda: bool(lines), lambda status: lines.append(sentence(status)))
    assert re.match(r"running: .* the recording lacks \d+ messages", lines[0])


def test_a_stop_ends_it_with_the_reason():
    with surroundings() as around:
        follower = TrajectoryFollower(ramp, 5.0, RAMP, around.connection)
        now = around.clock.now()
        around.servo.send(command(Mode.ARMED, time=now))
        around.servo.send(command(Mode.STOPPED, time=now + 0.01, stopped_by=Fault.TRACKING_ERROR))
        with pytest.raises(DeploymentError, match="tracking error"):
            follower.run(lambda: False, lambda _: None)
