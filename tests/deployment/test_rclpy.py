"""The transport by rclpy, on a stand-in; `test_transports` has the laws of all transports."""

import sys
from typing import Any

import pytest
import rclpy_stand_in
from rclpy_stand_in import Network

from domains import PATIENCE
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import ROS, RealClock, Topic, make_transport

NUMBER = Topic(name="/number", type=messages.NUMBER)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    return rclpy_stand_in.install(monkeypatch)


def test_the_age_of_a_message_is_that_of_its_stamp(network: Network):
    rate = 0.5
    network.delay = 3 * 10**9
    with make_transport("node", ROS, RealClock(rate)) as node:
        heard = node.subscription(NUMBER)
        node.publisher(NUMBER).publish(messages.number(1.0))
        assert node.wait(PATIENCE)
        (message,) = heard.take()
    assert 3.0 * rate <= message.age < 3.0 * rate + PATIENCE


def test_an_rclpy_without_stamps_of_messages_is_refused(network: Network, monkeypatch):
    monkeypatch.delattr(rclpy_stand_in.Endpoint, "CallbackType")
    with pytest.raises(DeploymentError, match="ROS 2 Iron"):
        make_transport("node", ROS, RealClock())


def test_a_type_that_ros_2_does_not_have_is_refused(network: Network):
    topic = Topic(name="/number", type="lab_msgs/msg/Number")
    with (
        make_transport("node", ROS, RealClock()) as node,
        pytest.raises(DeploymentError, match=r"/number: ROS 2 has no .* install lab_msgs"),
    ):
        node.subscription(topic)


def test_an_error_of_rclpy_is_reported(network: Network, monkeypatch):
    def refuse(*args: Any, **options: Any) -> None:
        raise RuntimeError("ROS_DOMAIN_ID is not an integral number")

    for name in ("create_node", "init"):
        monkeypatch.setattr(sys.modules["rclpy"], name, refuse)
        with pytest.raises(DeploymentError, match=r"cannot join .*not an integral number"):
            make_transport("node", ROS, RealClock())
