"""A trajectory on its way to the servo: from arming on, once, and not after a stop."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from loop_lab import HOME, PROFILE, Surroundings

from pixel2catch.deployment.follower import START_ERROR, follow
from pixel2catch.deployment.paths import Motion
from pixel2catch.errors import DeploymentError
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.link import Fault, JointTargets, Mode


def ramp(time: float) -> np.ndarray:
    return HOME + np.clip(time, 0.0, 0.1)


class Follower:
    """Follows a motion of 0.15 s, and keeps what it plans, sends and reports."""

    def __init__(self, around: Surroundings) -> None:
        self.around, self.starts = around, list[np.ndarray]()
        self.statuses, self.sent = list[dict[str, Any]](), list[JointTargets]()

    def run(self, is_over: Callable[[], bool] = lambda: False) -> bool:
        def plan(start: np.ndarray) -> Motion:
            self.starts.append(start)
            return Motion(at=ramp, duration=0.15)

        def report(status: dict[str, Any]) -> None:
            self.statuses.append(status)
            self.sent.extend(self.around.servo.receive())

        connection, topic = self.around.connection, PROFILE.operator.status
        return follow(plan, "test", connection, topic, is_over, report)


@pytest.fixture
def follower(around: Surroundings) -> Follower:
    return Follower(around)


def test_targets_are_those_of_the_time_since_the_ramp(follower: Follower, around: Surroundings):
    around.tick(Mode.ARMED)
    assert follower.run()
    shares = [status["done"] for status in follower.statuses]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert follower.statuses[-1]["message"] == "test: 0 s of motion. "
    assert len(follower.sent) > 10
    begin = follower.sent[0].target_stamp
    for targets in follower.sent:
        expected = ramp(targets.target_stamp - begin - ServoLimits.ramp_time)
        assert targets.joint_pos_target == pytest.approx(expected, abs=1e-3)
    (last,) = around.servo.receive()
    assert last.is_stop_requested


def test_a_robot_that_is_moved_before_it_is_armed_gets_a_new_plan(follower: Follower, around: Surroundings):
    """Nothing is planned before all joints are known, and nothing is sent before arming."""
    poses = iter((HOME * np.nan, HOME, HOME + 0.5 * START_ERROR, HOME + 2.0 * START_ERROR))

    def is_over() -> bool:
        joint_pos = next(poses, None)
        if joint_pos is not None:
            around.tick(Mode.IDLE, joint_pos=joint_pos)
        return joint_pos is None

    assert not follower.run(is_over)
    assert len(follower.starts) == 2
    assert around.servo.receive() == []


def test_a_stop_ends_it_with_the_reason(follower: Follower, around: Surroundings):
    now = around.clock.now()
    around.tick(Mode.ARMED, time=now)
    around.tick(Mode.STOPPED, time=now + 0.01, stopped_by=Fault.TRACKING_ERROR)
    with pytest.raises(DeploymentError, match="tracking error"):
        follower.run()
