"""The transport by rclpy: on its stand-in, and whether that is like the real one, where there is one.

`test_transports` has what every transport promises.
"""

import sys
from typing import Any

import numpy as np
import pytest
import rclpy_stand_in
from rclpy_stand_in import Network
from servo_rows import LIMITS

from domains import PATIENCE
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Topic, make_transport
from pixel2catch.servo.link import JointTargets
from pixel2catch.servo.process import ServoSubscriptions

NUMBER = Topic(name="/number", type=messages.NUMBER)
SWITCH = Topic(name="/pixel2catch/dead_man", type=messages.BOOLEAN)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return rclpy_stand_in.install(monkeypatch)


@pytest.mark.parametrize("rate", [1.0, 0.5])
def test_a_message_has_the_age_that_its_sender_s_stamp_tells(network: Network, rate: float):
    network.delay = 3 * 10**9
    with make_transport("ros", "node", LOOPBACK, RealClock(rate)) as node:
        heard = node.subscription(NUMBER)
        node.publisher(NUMBER).publish(messages.number(1.0))
        assert node.wait(PATIENCE)
        (message,) = heard.take()
    assert 3.0 * rate <= message.age < 3.0 * rate + PATIENCE


@pytest.mark.parametrize(("delay", "is_believed"), [(0, True), (300, False), (-300, False)])
def test_a_switch_counts_only_if_it_was_pressed_just_now(network: Network, delay: float, is_believed: bool):
    """A message of the switch that was 300 ms under way, or comes from the future, says nothing of now."""
    network.delay = round(1e6 * delay)
    with make_transport("ros", "servo", LOOPBACK, RealClock()) as node:
        heard = ServoSubscriptions(node, Profile.load("ur5e_allegro_v4"), LIMITS, ())
        node.publisher(SWITCH).publish(messages.boolean(True))
        assert node.wait(PATIENCE)
        heard.read(0.0)
        inputs = heard.inputs(0.0, JointTargets.none(LIMITS.num_joints))
        assert np.isfinite(inputs.dead_man_stamp[0]) == is_believed


def test_it_is_refused_where_it_would_speak_to_the_whole_network(network: Network, monkeypatch):
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    monkeypatch.delenv("ROS_LOCALHOST_ONLY", raising=False)
    with pytest.raises(DeploymentError, match="set ROS_LOCALHOST_ONLY=1 or ROS_AUTOMATIC_DISCOVERY_RANGE="):
        make_transport("ros", "node", LOOPBACK, RealClock())


def test_an_rclpy_that_does_not_tell_the_age_of_a_message_is_refused(network: Network, monkeypatch):
    monkeypatch.delattr(rclpy_stand_in.Subscription, "CallbackType")
    with pytest.raises(DeploymentError, match="ROS 2 Iron"):
        make_transport("ros", "node", LOOPBACK, RealClock())


def test_a_type_that_ros_2_does_not_have_is_refused(network: Network):
    topic = Topic(name="/number", type="lab_msgs/msg/Number")
    with (
        make_transport("ros", "node", LOOPBACK, RealClock()) as node,
        pytest.raises(DeploymentError, match=r"/number: ROS 2 has no .* install lab_msgs"),
    ):
        node.subscription(topic)


def test_what_keeps_rclpy_from_joining_is_said_in_words(network: Network, monkeypatch):
    def refuse(*args: Any, **options: Any) -> None:
        raise RuntimeError("ROS_DOMAIN_ID is not an integral number")

    for name in ("create_node", "init"):
        monkeypatch.setattr(sys.modules["rclpy"], name, refuse)
        with pytest.raises(DeploymentError, match=r"cannot join .*not an integral number"):
            make_transport("ros", "node", LOOPBACK, RealClock())
