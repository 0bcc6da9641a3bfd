"""Laws of all transports: memory, DDS and rclpy."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack

import pytest
from networks import MakeNode, dds_nodes, memory_nodes, ros_nodes

from domains import PATIENCE, own_domain
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.transport import Subscription, Topic, Transport

NUMBER = Topic(name="/number", type=messages.NUMBER)
MODE = Topic(name="/mode", type=messages.SAFETY_MODE, is_latched=True)
END = Topic(name="/end", type=messages.BOOLEAN)
IMAGE = Topic(name="/image", type=messages.IMAGE)


@pytest.fixture(params=[memory_nodes, dds_nodes, ros_nodes], ids=["memory", "dds", "ros"])
def make(request, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", own_domain())
    with ExitStack() as stack:
        yield request.param(stack)


def numbers(subscription: Subscription) -> list[float]:
    return [messages.read_number(message.data) for message in subscription.take()]


def wait_for(node: Transport, subscription: Subscription) -> bytes:
    assert node.wait(PATIENCE)
    (message,) = subscription.take()
    return message.data


def test_a_watching_subscription_does_not_end_a_wait(make: MakeNode):
    sender, receiver = make("sender"), make("receiver")
    recorded, awaited = receiver.subscription(NUMBER, only_watches=True), receiver.subscription(NUMBER)
    sender.publisher(NUMBER).publish(messages.number(1.5))
    assert messages.read_number(wait_for(receiver, awaited)) == 1.5
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
    begin = time.monotonic()
    while not end.take():
        assert time.monotonic() < begin + PATIENCE
    assert numbers(last) == [6.0]
    assert numbers(three) == [4.0, 5.0, 6.0]


def wait_until(is_so: Callable[[], bool]) -> None:
    """Wait until the network has found an endpoint or its end."""
    end = time.monotonic() + PATIENCE
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.001)


def test_only_latched_topics_reach_late_subscribers(make: MakeNode):
    sender = make("sender")
    latched, fleeting = sender.publisher(MODE), sender.publisher(NUMBER)
    for mode in (1, 3):
        latched.publish(messages.safety_mode(mode))
        fleeting.publish(messages.number(mode))
    receiver = make("receiver")
    late, missed = receiver.subscription(MODE, depth=5), receiver.subscription(NUMBER, depth=5)
    assert messages.read_safety_mode(wait_for(receiver, late)) == 3
    assert numbers(missed) == []


def test_other_publishers_are_counted_and_named_and_messages_have_their_sender(make: MakeNode):
    """With rclpy, messages have no sender."""
    mine, other, third = make("mine"), make("other"), make("third")
    heard = mine.subscription(NUMBER, depth=2)
    assert mine.num_other_publishers(NUMBER) == 0
    for _ in range(2):
        mine.publisher(NUMBER)
    senders = [node.publisher(NUMBER) for node in (other, third)]
    wait_until(lambda: [each.num_other_publishers(NUMBER) for each in (mine, other)] == [2, 3])
    wait_until(lambda: len(mine.other_publishers(NUMBER)) == 2)
    names, found = mine.other_publishers(NUMBER), set[int]()
    assert len({*names.values()}) == 2
    for sender in senders:
        sender.publish(messages.number(1.0))
        assert mine.wait(PATIENCE)
        (message,) = heard.take()
        found.add(message.sender)
    assert found == ({0} if "Ros" in type(mine).__name__ else {*names})
    third.close()
    wait_until(lambda: len(mine.other_publishers(NUMBER)) == 1)
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
    wait_until(lambda: publisher.num_subscribers() == 2)
    publisher.publish(messages.number(1.0))
    wait_until(lambda: numbers(watching) == [1.0])
    third.close()
    wait_until(lambda: publisher.num_subscribers() == 1)
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

    wait_until(lambda: found() == {(MODE.name, MODE.type, True), (NUMBER.name, NUMBER.type, False)})
    other.close()
    wait_until(lambda: not found())


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
