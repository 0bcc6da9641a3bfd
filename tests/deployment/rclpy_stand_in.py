"""The part of rclpy that `rclpy_node` uses, on the network in memory; names and parameters of rclpy 7.1."""

import inspect
import sys
import time
from collections import deque
from collections.abc import Callable
from enum import Enum
from importlib.util import find_spec, module_from_spec
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest

from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.messages import STORE
from pixel2catch.ros2.transport import RealClock, Topic

POLL = 0.002  #: Poll interval of an executor without messages [s].

Durability = Enum("QoSDurabilityPolicy", ["TRANSIENT_LOCAL", "VOLATILE"])
Reliability = Enum("QoSReliabilityPolicy", ["BEST_EFFORT", "RELIABLE"])
Signals = Enum("SignalHandlerOptions", ["NO"])


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
        self.is_latched = durability is Durability["TRANSIENT_LOCAL"]
        assert reliability is Reliability["RELIABLE"] or not self.is_latched


class Endpoint:
    """A publisher, or a subscription if it has a callback."""

    class CallbackType:
        """Iron and newer versions have it; see `rclpy_node`."""

    def __init__(
        self, node: "Node", msg_type: type, topic: str, qos_profile: QoSProfile, callback: Any = None
    ) -> None:
        (kind,) = (kind for kind, known in STORE.types.items() if known is msg_type)
        self.topic = Topic(name=topic, type=kind, is_latched=qos_profile.is_latched)
        self.node, self.qos_profile, self.callback, self.is_usable = node, qos_profile, callback, True
        self.end: Any = (
            node.memory.subscription(self.topic, qos_profile.depth)
            if callback
            else node.memory.publisher(self.topic)
        )

    def publish(self, msg: bytes) -> None:
        if not self.is_usable:
            raise RuntimeError("cannot use Destroyable because destruction was requested")
        assert isinstance(msg, bytes)
        self.end.publish(msg)

    def spin(self, delay: int) -> None:
        for message in self.end.take():
            self.callback(message.data, {"source_timestamp": time.time_ns() - delay})


class Node:
    def __init__(self, name: str, context: Context) -> None:
        self._name, self._network = name, context.network
        self._network.nodes.append(self)
        self.memory = self._network.broker.node(RealClock())
        self._endpoints: list[Endpoint] = []

    def create_publisher(self, msg_type: type, topic: str, qos_profile: QoSProfile) -> Endpoint:
        self._endpoints.append(Endpoint(self, msg_type, topic, qos_profile))
        return self._endpoints[-1]

    def create_subscription(
        self, msg_type: type, topic: str, callback: Any, qos_profile: QoSProfile, *, raw: bool
    ) -> Endpoint:
        assert raw, "else the callback gets no bytes"
        inspect.signature(callback).bind(object(), object())  # else rclpy gives no info of the message
        self._endpoints.append(Endpoint(self, msg_type, topic, qos_profile, callback))
        return self._endpoints[-1]

    def get_name(self) -> str:
        return self._name

    def _all(self) -> list[Endpoint]:
        return [each for node in self._network.nodes for each in node._endpoints]

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(name, [kind]) for name, kind in {(each.topic.name, each.topic.type) for each in self._all()}]

    def _infos(self, topic_name: str, *, publish: bool) -> list[SimpleNamespace]:
        return [
            SimpleNamespace(
                node_name=each.node.get_name(),
                topic_type=each.topic.type,
                qos_profile=each.qos_profile,
                endpoint_gid=[*id(each.node).to_bytes(12), *(id(each) % 2**32).to_bytes(4)],
            )
            for each in self._all()
            if each.topic.name == topic_name and publish == (each.callback is None)
        ]

    def get_publishers_info_by_topic(self, topic_name: str) -> list[SimpleNamespace]:
        return self._infos(topic_name, publish=True)

    def get_subscriptions_info_by_topic(self, topic_name: str) -> list[SimpleNamespace]:
        return self._infos(topic_name, publish=False)

    def destroy_node(self) -> None:
        self._network.nodes.remove(self)
        for each in self._endpoints:
            each.is_usable = False
        self.memory.close()

    def spin(self) -> None:
        for each in list(self._endpoints):
            if each.callback:
                each.spin(self._network.delay)


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


def get_message(identifier: str) -> type:
    try:
        return STORE.types[identifier]
    except KeyError:
        raise ModuleNotFoundError(f"No module named '{identifier.partition('/')[0]}'") from None


STAND_IN: dict[str, dict[str, Any]] = {
    "rclpy": {"init": init, "create_node": create_node, "try_shutdown": lambda *, context: None},
    "rclpy.context": {"Context": Context},
    "rclpy.executors": {"SingleThreadedExecutor": SingleThreadedExecutor},
    "rclpy.qos": {
        "QoSDurabilityPolicy": Durability,
        "QoSProfile": QoSProfile,
        "QoSReliabilityPolicy": Reliability,
    },
    "rclpy.signals": {"SignalHandlerOptions": Signals},
    "rclpy.subscription": {"Subscription": Endpoint},
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
