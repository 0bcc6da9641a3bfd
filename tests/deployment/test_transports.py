"""Laws of all transports, memory, DDS and rclpy, which has a stand-in here; and of rclpy's."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import find_spec
from typing import Any

import pytest
import rclpy_stand_in
from rclpy_stand_in import Network

from domains import PATIENCE, own_domain, until
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.transport import ANY, LOOPBACK, ROS, Message, RealClock, Subscription, Topic, Transport
from pixel2catch.ros2.transport import make_transport as join

NUMBER = Topic(name="/number", type=messages.NUMBER)
MODE = Topic(name="/mode", type=messages.SAFETY_MODE, is_latched=True)
END = Topic(name="/end", type=messages.BOOLEAN)
IMAGE = Topic(name="/image", type=messages.IMAGE)

MakeNode = Callable[[str], Transport]
"""Makes a node with a name, on a network that no other test is on."""


@pytest.fixture(params=["memory", LOOPBACK, ROS])
def make(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch):
    """With the rclpy that is installed, or else its stand-in."""
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    broker, name = Broker(), request.param
    if name == ROS and not find_spec("rclpy"):
        rclpy_stand_in.install(monkeypatch)
    with ExitStack() as stack:
        yield lambda node: stack.enter_context(
            broker.node(RealClock()) if name == "memory" else join(node, name, RealClock())
        )


def numbers(subscription: Subscription) -> list[float]:
    return [messages.read_number(message.data) for message in subscription.take()]


def wait_for(node: Transport, subscription: Subscription) -> Message:
    assert node.wait(PATIENCE)
    (message,) = subscription.take()
    return message


def test_a_watching_subscription_does_not_end_a_wait(make: MakeNode):
    sender, receiver = make("sender"), make("receiver")
    recorded, awaited = receiver.subscription(NUMBER, only_watches=True), receiver.subscription(NUMBER)
    sender.publisher(NUMBER).publish(messages.number(1.5))
    assert messages.read_number(wait_for(receiver, awaited).data) == 1.5
    assert not receiver.wait(0.05)
    assert numbers(recorded) == [1.5]


def test_the_newest_messages_are_kept_in_order(make: MakeNode):
    sender, receiver = make("sender"), make("receiver")
    last, three = receiver.subscription(NUMBER), receiver.subscription(NUMBER, depth=3)
    end = receiver.subscription(END)
    publisher = sender.publisher(NUMBER)
    for value in range(7):
        publisher.publish(messages.number(value))
    sender.publisher(END).publish(messages.boolean(True))
    until(lambda: bool(end.take()))
    assert numbers(last) == [6.0]
    assert numbers(three) == [4.0, 5.0, 6.0]


def test_only_latched_topics_reach_late_subscribers(make: MakeNode):
    sender = make("sender")
    latched, fleeting = sender.publisher(MODE), sender.publisher(NUMBER)
    for mode in (1, 3):
        latched.publish(messages.safety_mode(mode))
        fleeting.publish(messages.number(mode))
    receiver = make("receiver")
    late, missed = receiver.subscription(MODE, depth=5), receiver.subscription(NUMBER, depth=5)
    assert messages.read_safety_mode(wait_for(receiver, late).data) == 3
    assert numbers(missed) == []


def test_other_publishers_are_counted_and_named_and_messages_have_their_sender(make: MakeNode):
    """With rclpy, messages have no sender."""
    mine, other, third = make("mine"), make("other"), make("third")
    heard = mine.subscription(NUMBER, depth=2)
    assert mine.num_other_publishers(NUMBER) == 0
    for _ in range(2):
        mine.publisher(NUMBER)
    senders = [node.publisher(NUMBER) for node in (other, third)]
    until(lambda: [each.num_other_publishers(NUMBER) for each in (mine, other)] == [2, 3])
    until(lambda: len(mine.other_publishers(NUMBER)) == 2)
    names, found = mine.other_publishers(NUMBER), set[int]()
    assert len({*names.values()}) == 2
    for sender in senders:
        sender.publish(messages.number(1.0))
        found.add(wait_for(mine, heard).sender)
    assert found == ({0} if "Ros" in type(mine).__name__ else {*names})
    third.close()
    until(lambda: len(mine.other_publishers(NUMBER)) == 1)
    assert mine.other_publishers(NUMBER).items() <= names.items()
    assert mine.num_other_publishers(NUMBER) == 1
    with pytest.raises(DeploymentError, match="/number cannot be sent"):
        senders[-1].publish(messages.number(0.0))


def test_programs_that_subscribe_are_counted_except_watching_ones(make: MakeNode):
    """The node of the Allegro V5 subscribes twice, and is one program."""
    mine, other, third, watcher = (make(name) for name in ("mine", "other", "third", "pixel2catch"))
    publisher = mine.publisher(NUMBER)
    assert publisher.num_subscribers() == 0
    watching = watcher.subscription(NUMBER, only_watches=True)
    watcher.num_other_publishers(NUMBER)
    for node in (other, other, third):
        node.subscription(NUMBER)
    third.subscription(Topic(name=NUMBER.name, type=messages.TEXT))
    third.subscription(Topic(name=NUMBER.name, type=NUMBER.type, is_latched=True))  # it does not fit
    until(lambda: publisher.num_subscribers() == 2)
    publisher.publish(messages.number(1.0))
    until(lambda: numbers(watching) == [1.0])
    third.close()
    until(lambda: publisher.num_subscribers() == 1)
    programs = [each.program for each in mine.endpoints() if each.topic == NUMBER.name]
    assert (len(programs), len({*programs})) == (2, 1)


def test_endpoints_of_others_are_listed(make: MakeNode):
    node, other = make("node"), make("other")
    node.publisher(NUMBER)
    node.subscription(IMAGE)
    other.publisher(MODE)
    other.subscription(NUMBER)

    def found() -> set[tuple[str, str, bool]]:
        ours = {topic.name for topic in (NUMBER, IMAGE, MODE)}  # ROS 2 has topics of its own
        listed = (each for each in node.endpoints() if each.topic in ours)
        return {(each.topic, each.type, each.is_publisher) for each in listed}

    until(lambda: found() == {(MODE.name, MODE.type, True), (NUMBER.name, NUMBER.type, False)})
    other.close()
    until(lambda: not found())


def test_waiting_ends_when_a_message_arrives(make: MakeNode):
    sender, receiver = make("sender"), make("receiver")
    subscription, publisher = receiver.subscription(NUMBER), sender.publisher(NUMBER)
    begin = time.perf_counter()
    assert not receiver.wait(0.05)
    assert time.perf_counter() - begin >= 0.049
    threading.Timer(0.05, publisher.publish, [messages.number(1.0)]).start()
    begin = time.perf_counter()
    assert receiver.wait(2.0 * PATIENCE)
    assert time.perf_counter() - begin < PATIENCE
    assert receiver.wait(0.0)
    assert numbers(subscription) == [1.0]
    assert not receiver.wait(0.0)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    return rclpy_stand_in.install(monkeypatch)


def test_the_age_of_a_message_is_that_of_its_stamp(network: Network):
    rate = 0.5
    network.delay = 3 * 10**9
    with join("node", ROS, RealClock(rate)) as node:
        heard = node.subscription(NUMBER)
        node.publisher(NUMBER).publish(messages.number(1.0))
        age = wait_for(node, heard).age
    assert 3.0 * rate <= age < 3.0 * rate + PATIENCE


def test_an_rclpy_without_stamps_of_messages_is_refused(network: Network, monkeypatch):
    monkeypatch.delattr(rclpy_stand_in.Subscription, "CallbackType")
    with pytest.raises(DeploymentError, match="ROS 2 Iron"):
        join("node", ROS, RealClock())


def test_a_type_that_ros_2_does_not_have_is_refused(network: Network):
    topic = Topic(name="/number", type="lab_msgs/msg/Number")
    with (
        join("node", ROS, RealClock()) as node,
        pytest.raises(DeploymentError, match=r"/number: ROS 2 has no .* install lab_msgs"),
    ):
        node.subscription(topic)


def test_an_error_of_rclpy_is_reported(network: Network, monkeypatch):
    def refuse(*args: Any, **options: Any) -> None:
        raise RuntimeError("ROS_DOMAIN_ID is not an integral number")

    for name in ("create_node", "init"):
        monkeypatch.setattr(rclpy_stand_in, name, refuse)
        with pytest.raises(DeploymentError, match=r"cannot join .*not an integral number"):
            join("node", ROS, RealClock())


def test_with_security_other_networks_are_refused(monkeypatch):
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    with pytest.raises(DeploymentError, match="ROS_SECURITY_ENABLE, which is true: give --network ros"):
        join("node", ANY, RealClock())
