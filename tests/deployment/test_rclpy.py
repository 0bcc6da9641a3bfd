"""The transport by rclpy: on its stand-in, and whether that is like the real one, where there is one.

`test_transports` has what every transport promises.
"""

import importlib
import inspect
import sys
import threading
from enum import Enum
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
import rclpy_stand_in
from rclpy_stand_in import API, STAND_IN, Network
from servo_rows import LIMITS

from domains import PATIENCE
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.factory import make_transport
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, RealClock, Topic
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
    with pytest.raises(DeploymentError, match="take ROS 2 Iron or a newer one, or the transport dds"):
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
        with pytest.raises(
            DeploymentError, match=r"cannot join .*not an integral number.*look at ROS_DOMAIN_ID"
        ):
            make_transport("ros", "node", LOOPBACK, RealClock())


def test_a_node_may_be_closed_twice_and_its_thread_ends(network: Network):
    before = set(threading.enumerate())
    node = make_transport("ros", "node", LOOPBACK, RealClock())
    assert len(set(threading.enumerate()) - before) == 1
    node.close()
    node.close()
    assert set(threading.enumerate()) == before


def test_the_stand_in_has_nothing_that_is_not_in_the_table():
    known = {*API["functions"], *API["members"]}
    for module, members in STAND_IN.items():
        for name, member in members.items():
            assert f"{module}.{name}" in known or name == "Subscription"
            if inspect.isclass(member) and not issubclass(member, Enum):
                assert {each for each in vars(member) if not each.startswith("_")} <= OWN_OF_STAND_IN | {
                    function.removeprefix(f"{module}.{name}.") for function in known
                }


OWN_OF_STAND_IN = {"network", "is_usable", "topic", "info", "spin", "CallbackType"}
"""What classes of the stand-in have beside it; `rclpy_node` uses the last one."""


@pytest.mark.parametrize(
    "call",
    [
        lambda rclpy, context: rclpy.init(args=[], context=context, domain=3),
        lambda rclpy, context: rclpy.create_node(context=context),
        lambda rclpy, context: rclpy.try_shutdown(context),
        lambda rclpy, context: rclpy.shutdown(context=context),
        lambda rclpy, context: rclpy.create_node("node", context=context),
    ],
    ids=["unknown option", "no name", "by position", "unknown function", "context before init"],
)
def test_the_stand_in_raises_on_what_rclpy_raises_on(network: Network, call: Any):
    rclpy = sys.modules["rclpy"]
    context = rclpy_stand_in.Context()
    with pytest.raises((TypeError, AttributeError, RuntimeError)):
        call(rclpy, context)


@pytest.mark.skipif(not find_spec("rclpy"), reason="ROS 2 is not sourced")
def test_the_table_is_that_of_the_real_rclpy():
    if version("rclpy") != API["rclpy"]:
        pytest.skip(f"the table is of rclpy {API['rclpy']}")
    for name, text in API["functions"].items():
        assert described(real(name)) == text, name
    for name in ("rclpy.qos.QoSDurabilityPolicy", "rclpy.qos.QoSReliabilityPolicy"):
        assert set(API["members"][name]) <= set(real(name).__members__)
    assert hasattr(real("rclpy.signals.SignalHandlerOptions"), "NO")
    assert hasattr(real("rclpy.subscription.Subscription"), "CallbackType")


def real(name: str) -> Any:
    """A function or class of the real rclpy by its name."""
    place, _, last = name.rpartition(".")
    try:
        return getattr(importlib.import_module(place), last)
    except ModuleNotFoundError:
        return getattr(real(place), last)


def described(function: Any) -> str:
    """A function's parameters as the table has them: a default that is no plain value is `...`."""
    signature = inspect.signature(function)
    plain = (type(None), bool, int, float, str)
    parameters = [
        each.replace(
            annotation=each.empty,
            default=each.default if each.default is each.empty or isinstance(each.default, plain) else ...,
        )
        for each in signature.parameters.values()
    ]
    text = str(signature.replace(parameters=parameters, return_annotation=signature.empty))
    return text.replace("Ellipsis", "...")
