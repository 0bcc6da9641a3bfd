"""A trajectory on its way to the servo: from the moment of arming, once, and not after a stop."""

import numpy as np
import pytest
from loop_lab import HOME, decision, surroundings

from pixel2catch.deployment.follower import Follower
from pixel2catch.errors import DeploymentError
from pixel2catch.servo.link import Orders
from pixel2catch.servo.state import Mode
from pixel2catch.servo.watchdogs import Fault

RAMP = 0.05


def ramp(time: float) -> np.ndarray:
    return HOME + np.clip(time, 0.0, 0.1)


def test_targets_are_those_of_the_time_since_the_ramp():
    with surroundings() as around:
        follower, received = Follower(ramp, 0.15, RAMP, around.connection), list[Orders]()
        armed_at = around.clock.now()
        around.servo.send(decision(Mode.ARMED, time=armed_at))
        follower.run(lambda: False, lambda _: received.extend(around.servo.receive()))
        assert follower.is_done
        assert len(received) > 10
        for orders in received:
            expected = ramp(orders.target_stamp - armed_at - RAMP)
            assert orders.joint_pos_target == pytest.approx(expected, abs=1e-9)
        (last,) = around.servo.receive()
        assert last.is_stop_requested


def test_nothing_is_ordered_before_it_is_armed():
    with surroundings() as around:
        follower, num_calls = Follower(ramp, 0.1, RAMP, around.connection), 0

        def count(_: object) -> None:
            nonlocal num_calls
            num_calls += 1

        around.servo.send(decision(Mode.IDLE, time=around.clock.now()))
        follower.run(lambda: num_calls > 3, count)
        assert around.servo.receive() == []
        assert not follower.is_done


def test_a_stop_ends_it_with_the_reason():
    with surroundings() as around:
        follower = Follower(ramp, 5.0, RAMP, around.connection)
        now = around.clock.now()
        around.servo.send(decision(Mode.ARMED, time=now))
        around.servo.send(decision(Mode.STOPPED, time=now + 0.01, stopped_by=Fault.TRACKING_ERROR))
        with pytest.raises(DeploymentError, match="tracking error"):
            follower.run(lambda: False, lambda _: None)
