"""The part of rclpy that `rclpy_node` uses, on the network in memory; names and parameters of rclpy 7.1.

This file stands for each module of rclpy.
"""

import inspect
import sys
import time
from collections import deque
from collections.abc import Callable
from enum import Enum
from functools import partialmethod
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.messages import STORE
from pixel2catch.ros2.transport import RealClock, Topic

POLL = 0.002  #: Poll interval of an executor without messages [s].

QoSDurabilityPolicy = Enum("QoSDurabilityPolicy", ["TRANSIENT_LOCAL", "VOLATILE"])
QoSReliabilityPolicy = Enum("QoSReliabilityPolicy", ["BEST_EFFORT", "RELIABLE"])
SignalHandlerOptions = Enum("SignalHandlerOptions", ["NO"])


class Network:
    """The nodes of one test, and the delay of their messages [ns]."""

    def __init__(self) -> None:
        self.broker, self.delay = Broker(), 0
        self.nodes: list[Node] = []


class Context:
    network: ClassVar[Network]


class QoSProfile:
    def __init__(self, *, depth: int, reliability: Any, durability: Any) -> None:
        self.depth, self.durability = depth, durability
        self.is_latched = durability is QoSDurabilityPolicy["TRANSIENT_LOCAL"]
        assert reliability is QoSReliabilityPolicy["RELIABLE"] or not self.is_latched


class Subscription:
    """A publisher, or a subscription if it has a callback."""

    class CallbackType:
        """Iron and newer versions have it; see `rclpy_node`."""

    def __init__(
        self, node: "Node", msg_type: type, topic: str, qos_profile: QoSProfile, callback: Any = None
    ) -> None:
        (kind,) = (kind for kind, known in STORE.types.items() if known is msg_type)
        self.topic = Topic(name=topic, type=kind, is_latched=qos_profile.is_latched)
        self.node, self.qos_profile, self.callback = node, qos_profile, callback
        make = node.memory.subscription if callback else node.memory.publisher
        self.end: Any = make(self.topic, *([qos_profile.depth] if callback else []))

    def publish(self, msg: bytes) -> None:
        if self.node not in self.node.network.nodes:
            raise RuntimeError("cannot use Destroyable because destruction was requested")
        assert isinstance(msg, bytes)
        self.end.publish(msg)

    def spin(self) -> None:
        for message in self.end.take() if self.callback else ():
            self.callback(message.data, {"source_timestamp": time.time_ns() - self.node.network.delay})


class Node:
    def __init__(self, name: str, network: Network) -> None:
        self._name, self.network = name, network
        self.network.nodes.append(self)
        self.memory = self.network.broker.node(RealClock())
        self.endpoints: list[Subscription] = []

    def create_publisher(
        self, msg_type: type, topic: str, qos_profile: QoSProfile, callback: Any = None
    ) -> Any:
        self.endpoints.append(Subscription(self, msg_type, topic, qos_profile, callback))
        return self.endpoints[-1]

    def create_subscription(
        self, msg_type: type, topic: str, callback: Any, qos_profile: QoSProfile, *, raw: bool
    ) -> Subscription:
        assert raw, "else the callback gets no bytes"
        inspect.signature(callback).bind(object(), object())  # else rclpy gives no info of the message
        return self.create_publisher(msg_type, topic, qos_profile, callback)

    def get_name(self) -> str:
        return self._name

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        found = {(e.topic.name, e.topic.type) for node in self.network.nodes for e in node.endpoints}
        return [(name, [kind]) for name, kind in found]

    def get_publishers_info_by_topic(self, topic_name: str, *, publish: bool = True) -> list[SimpleNamespace]:
        return [
            SimpleNamespace(
                node_name=node.get_name(),
                topic_type=each.topic.type,
                qos_profile=each.qos_profile,
                endpoint_gid=[*id(node).to_bytes(12), *(id(each) % 2**32).to_bytes(4)],
            )
            for node in self.network.nodes
            for each in node.endpoints
            if each.topic.name == topic_name and publish == (each.callback is None)
        ]

    get_subscriptions_info_by_topic = partialmethod(get_publishers_info_by_topic, publish=False)

    def destroy_node(self) -> None:
        self.network.nodes.remove(self)
        self.memory.close()


class SingleThreadedExecutor:
    def __init__(self, *, context: Context) -> None:
        self._tasks: deque[Callable[[], Any]] = deque()

    def add_node(self, node: Node) -> bool:
        self._node = node
        return True

    def create_task(self, callback: Callable[[], Any]) -> None:
        self._tasks.append(callback)

    def spin_once(self) -> None:
        while not self._tasks:
            if self._node.memory.wait(POLL):
                for each in list(self._node.endpoints):
                    each.spin()
                return
        self._tasks.popleft()()

    def shutdown(self) -> bool:
        return True


def init(*, args: list[str], context: Context, signal_handler_options: Any) -> None:
    assert args == [], "else rclpy reads the command line"
    assert signal_handler_options is SignalHandlerOptions["NO"], "commands have their own handlers"


def try_shutdown(*, context: Context) -> None:
    pass


def create_node(
    node_name: str, *, context: Context, enable_rosout: bool, start_parameter_services: bool
) -> Node:
    assert node_name.isidentifier()
    return Node(node_name, context.network)


def get_message(identifier: str) -> type:
    if identifier not in STORE.types:
        raise ModuleNotFoundError(f"No module named '{identifier.partition('/')[0]}'")
    return STORE.types[identifier]


MODULES = ("rclpy", *(f"rclpy.{name}" for name in ("context", "executors", "qos", "signals", "subscription")))


def install(patch: pytest.MonkeyPatch) -> Network:
    """Install the stand-in as rclpy until the end of a test, with an own network."""
    for name in (*MODULES, "rosidl_runtime_py", "rosidl_runtime_py.utilities"):
        patch.setitem(sys.modules, name, sys.modules[__name__])
    patch.setattr(Context, "network", network := Network(), raising=False)
    return network
