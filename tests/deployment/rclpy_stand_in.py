"""The part of rclpy that `rclpy_node` uses, on the network in memory; names and parameters of rclpy 7.1."""

import inspect
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any, ClassVar

import pytest

from pixel2catch.ros2.memory import Broker, MemoryTransport
from pixel2catch.ros2.messages import STORE
from pixel2catch.ros2.transport import RealClock, Topic

POLL = 0.002  #: Poll interval of an executor without messages [s].


class Network:
    """The nodes of one test, and the delay of their messages [ns]."""

    def __init__(self) -> None:
        self.broker, self.delay = Broker(), 0
        self.nodes: list[Node] = []


class Context:
    network: ClassVar[Network]


Durability = Enum("QoSDurabilityPolicy", ["TRANSIENT_LOCAL", "VOLATILE"])
Reliability = Enum("QoSReliabilityPolicy", ["BEST_EFFORT", "RELIABLE"])
Signals = Enum("SignalHandlerOptions", ["NO"])


class QoSProfile:
    def __init__(self, *, depth: int, reliability: Any, durability: Any) -> None:
        self._depth, self.durability = depth, durability
        self._is_latched = durability is Durability["TRANSIENT_LOCAL"]
        assert reliability is Reliability["RELIABLE"] or not self._is_latched

    def topic(self, msg_type: type, name: str) -> Topic:
        (kind,) = (kind for kind, known in STORE.types.items() if known is msg_type)
        return Topic(name=name, type=kind, is_latched=self._is_latched)


@dataclass
class TopicEndpointInfo:
    """The used part of the description of a publisher or a subscription."""

    node_name: str
    topic_type: str
    qos_profile: QoSProfile
    endpoint_gid: list[int]


class Endpoint:
    def __init__(self, msg_type: type, topic: str, qos_profile: QoSProfile) -> None:
        self.topic, self._qos_profile = qos_profile.topic(msg_type, topic), qos_profile

    def info(self, node_name: str) -> TopicEndpointInfo:
        gid = [*id(self).to_bytes(16)]
        return TopicEndpointInfo(node_name, self.topic.type, self._qos_profile, gid)


class Publisher(Endpoint):
    is_usable = True

    def __init__(self, node: MemoryTransport, *described: Any) -> None:
        super().__init__(*described)
        self._publisher = node.publisher(self.topic)

    def publish(self, msg: bytes) -> None:
        if not self.is_usable:
            raise RuntimeError("cannot use Destroyable because destruction was requested")
        assert isinstance(msg, bytes)
        self._publisher.publish(msg)


class Subscription(Endpoint):
    class CallbackType:
        """Iron and newer versions have it; see `rclpy_node`."""

    def __init__(self, node: MemoryTransport, callback: Any, *described: Any) -> None:
        super().__init__(*described)
        self._callback, self.messages = callback, node.subscription(self.topic, self._qos_profile._depth)
        inspect.signature(callback).bind(object(), object())  # else rclpy gives no info of the message

    def spin(self, delay: int) -> None:
        for message in self.messages.take():
            info = {"source_timestamp": time.time_ns() - delay}
            self._callback(message.data, info)


class Node:
    def __init__(self, name: str, context: Context) -> None:
        self._name, self._network = name, context.network
        self._network.nodes.append(self)
        self.memory = self._network.broker.node(RealClock())
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []

    def create_publisher(self, msg_type: type, topic: str, qos_profile: QoSProfile) -> Publisher:
        self._publishers.append(Publisher(self.memory, msg_type, topic, qos_profile))
        return self._publishers[-1]

    def create_subscription(
        self, msg_type: type, topic: str, callback: Any, qos_profile: QoSProfile, *, raw: bool
    ) -> Subscription:
        assert raw, "else the callback gets no bytes"
        self._subscriptions.append(Subscription(self.memory, callback, msg_type, topic, qos_profile))
        return self._subscriptions[-1]

    def get_name(self) -> str:
        return self._name

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        both = (each for node in self._network.nodes for each in (*node._publishers, *node._subscriptions))
        return [(name, [kind]) for name, kind in {(each.topic.name, each.topic.type) for each in both}]

    def get_publishers_info_by_topic(self, topic_name: str) -> list[TopicEndpointInfo]:
        found = [(node, each) for node in self._network.nodes for each in node._publishers]
        return [each.info(node._name) for node, each in found if each.topic.name == topic_name]

    def get_subscriptions_info_by_topic(self, topic_name: str) -> list[TopicEndpointInfo]:
        found = [(node, each) for node in self._network.nodes for each in node._subscriptions]
        return [each.info(node._name) for node, each in found if each.topic.name == topic_name]

    def destroy_node(self) -> None:
        self._network.nodes.remove(self)
        for publisher in self._publishers:
            publisher.is_usable = False
        self.memory.close()

    def spin(self) -> None:
        for subscription in list(self._subscriptions):
            subscription.spin(self._network.delay)


class SingleThreadedExecutor:
    def __init__(self, *, context: Context) -> None:
        self._nodes: list[Node] = []
        self._tasks: deque[Callable[[], Any]] = deque()

    def add_node(self, node: Node) -> bool:
        self._nodes.append(node)
        return True

    def create_task(self, callback: Callable[[], Any]) -> None:
        self._tasks.append(callback)

    def spin_once(self) -> None:
        (node,) = self._nodes
        while not self._tasks:
            if node.memory.wait(POLL):
                return node.spin()
        return self._tasks.popleft()()

    def shutdown(self) -> bool:
        self._nodes.clear()
        return True


def init(*, args: list[str], context: Context, signal_handler_options: Any) -> None:
    assert args == [], "else rclpy reads the command line"
    assert signal_handler_options is Signals["NO"], "commands have their own handlers"
    del context


def create_node(
    node_name: str, *, context: Context, enable_rosout: bool, start_parameter_services: bool
) -> Node:
    assert node_name.isidentifier()
    return Node(node_name, context)


def try_shutdown(*, context: Context) -> None:
    del context


def get_message(identifier: str) -> type:
    try:
        return STORE.types[identifier]
    except KeyError:
        raise ModuleNotFoundError(f"No module named '{identifier.partition('/')[0]}'") from None


STAND_IN = {
    "rclpy": {"init": init, "create_node": create_node, "try_shutdown": try_shutdown},
    "rclpy.context": {"Context": Context},
    "rclpy.executors": {"SingleThreadedExecutor": SingleThreadedExecutor},
    "rclpy.qos": {
        "QoSDurabilityPolicy": Durability,
        "QoSProfile": QoSProfile,
        "QoSReliabilityPolicy": Reliability,
    },
    "rclpy.signals": {"SignalHandlerOptions": Signals},
    "rclpy.subscription": {"Subscription": Subscription},
    "rosidl_runtime_py": {},
    "rosidl_runtime_py.utilities": {"get_message": get_message},
}


NODE = "pixel2catch.ros2.rclpy_node"


def install(patch: pytest.MonkeyPatch) -> Network:
    """Install the stand-in as rclpy until the end of a test, with an own network."""
    for name, members in STAND_IN.items():
        module = ModuleType(name)
        vars(module).update(members)
        patch.setitem(sys.modules, name, module)
    specification = find_spec(NODE)
    assert specification is not None
    assert specification.loader is not None
    module = module_from_spec(specification)
    patch.setitem(sys.modules, NODE, module)
    specification.loader.exec_module(module)
    patch.setattr(Context, "network", network := Network(), raising=False)
    return network
