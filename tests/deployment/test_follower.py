"""A trajectory on its way to the servo: from arming on, once, and not after a stop."""

import re
from typing import Any

import numpy as np
import pytest
from loop_lab import HOME, Surroundings

from pixel2catch.deployment.follower import follow
from pixel2catch.errors import DeploymentError
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Fault, JointTargets, Mode
from pixel2catch.servo.status_words import sentence


def ramp(time: float) -> np.ndarray:
    return HOME + np.clip(time, 0.0, 0.1)


def test_targets_are_those_of_the_time_since_the_ramp(around: Surroundings):
    received, armed_at, shares = list[JointTargets](), around.clock.now(), list[float]()
    around.tick(Mode.ARMED, time=armed_at)

    def report(status: dict[str, Any]) -> None:
        received.extend(around.servo.receive())
        shares.append(status["done"])

    assert follow(ramp, 0.15, around.connection, lambda: False, report)
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert len(received) > 10
    for targets in received:
        expected = ramp(targets.target_stamp - armed_at - ServoLimits.ramp_time)
        assert targets.joint_pos_target == pytest.approx(expected, abs=1e-9)
    (last,) = around.servo.receive()
    assert last.is_stop_requested


def test_no_target_is_sent_before_arming(around: Surroundings):
    statuses = list[object]()
    around.tick(Mode.IDLE)
    assert not follow(ramp, 0.1, around.connection, lambda: len(statuses) > 3, statuses.append)
    assert around.servo.receive() == []


def test_an_incomplete_recording_is_reported_while_it_follows(badly_recorded: Surroundings):
    lines = list[str]()
    badly_recorded.tick(Mode.RUN)
    follow(ramp, 0.15, badly_recorded.connection, lambda: bool(lines), lambda it: lines.append(sentence(it)))
    assert re.match(r"running: .* the recording lacks \d+ messages", lines[0])


def test_a_stop_ends_it_with_the_reason(around: Surroundings):
    now = around.clock.now()
    around.tick(Mode.ARMED, time=now)
    around.tick(Mode.STOPPED, time=now + 0.01, stopped_by=Fault.TRACKING_ERROR)
    with pytest.raises(DeploymentError, match="tracking error"):
        follow(ramp, 5.0, around.connection, lambda: False, lambda _: None)
