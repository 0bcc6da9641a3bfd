"""The network of ROS 2 by rclpy, where ROS 2 is sourced: for middlewares that `dds` does not speak.

Written from rclpy's documentation (Humble to Kilted) and never run: this project is tested with `dds` only.
"""

# pyright: reportMissingImports=false
# ROS 2 is no package of pip's.

import os
from threading import Thread
from typing import Any, final

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosidl_runtime_py.utilities import get_message

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.memory import MessageQueues
from pixel2catch.ros2.transport import ANY, LOOPBACK, Clock, Publisher, Subscription, Topic, Transport

LOCALHOST = {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
"""What keeps ROS 2 to this machine: the first in Humble, the second from Iron on."""

OWN_NODES = "pixel2catch"  #: What the names of our nodes begin with; they only watch what others are to take.


@final
class RosTransport(Transport):
    """A node of rclpy, with a thread that receives."""

    def __init__(self, node_name: str, clock: Clock, *, network: str) -> None:
        """Join.

        Raises:
            DeploymentError: It may speak to this machine only, and ROS 2 is not set so, or to one interface,
                which rclpy cannot choose.
        """
        if network == LOOPBACK and not any(
            os.environ.get(name) == value for name, value in LOCALHOST.items()
        ):
            settings = " or ".join(f"{name}={value}" for name, value in LOCALHOST.items())
            raise DeploymentError(f"ROS 2 would speak to the whole network: set {settings} first.")
        if network not in (LOOPBACK, ANY):
            raise DeploymentError(
                f"rclpy cannot be told to speak to {network}: take --network {ANY}, and name the interface "
                "in the settings of its middleware, such as CYCLONEDDS_URI."
            )
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node(node_name, context=self._context)
        self._queues = MessageQueues(clock)
        self._num_own: dict[str, int] = {}
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._receiver = Thread(target=self._executor.spin, name="rclpy", daemon=True)
        self._receiver.start()

    def publisher(self, topic: Topic) -> Publisher:
        """Announce a topic that this node sends."""
        self._num_own[topic.name] = self._num_own.get(topic.name, 0) + 1
        qos = _qos(topic, 1, is_reader=False)
        return _RosPublisher(self._node, self._node.create_publisher(_type(topic), topic.name, qos))

    def subscription(self, topic: Topic, depth: int = 1, *, only_watches: bool = False) -> Subscription:
        """See `Transport.subscription`; who only watches is known by the name of its node."""
        queue = self._queues.add(depth, is_awaited=not only_watches)
        qos = _qos(topic, depth, is_reader=True)
        self._node.create_subscription(_type(topic), topic.name, queue.put, qos, raw=True)
        return queue

    def num_other_publishers(self, topic: Topic) -> int:
        """How many publishers of a topic there are besides those of this node."""
        return max(0, self._node.count_publishers(topic.name) - self._num_own.get(topic.name, 0))

    def wait(self, seconds: float) -> bool:
        """See `Transport.wait`."""
        return self._queues.wait(seconds)

    def close(self) -> None:
        """Leave the network."""
        self._executor.shutdown()
        self._receiver.join(timeout=1.0)
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)


@final
class _RosPublisher(Publisher):
    def __init__(self, node: Any, publisher: Any) -> None:
        self._node, self._publisher = node, publisher

    def publish(self, data: bytes) -> None:
        self._publisher.publish(data)

    def num_subscribers(self) -> int:
        found = self._node.get_subscriptions_info_by_topic(self._publisher.topic_name)
        return sum(not info.node_name.startswith(OWN_NODES) for info in found)


def _type(topic: Topic) -> Any:
    """The message's class; its package must be installed, as ur_dashboard_msgs is with UR's driver."""
    try:
        return get_message(topic.type)
    except (AttributeError, ModuleNotFoundError, ValueError) as error:
        package = topic.type.partition("/")[0]
        message = f"{topic.name}: ROS 2 has no {topic.type} ({error}): install {package}."
        raise DeploymentError(message) from error


def _qos(topic: Topic, depth: int, *, is_reader: bool) -> QoSProfile:
    """Writers are reliable, and keep the last message of latched topics for late subscribers.

    A best-effort reader hears every publisher; latched messages must be asked for reliably.
    """
    is_reliable = topic.is_latched or not is_reader
    return QoSProfile(
        depth=depth,
        reliability=QoSReliabilityPolicy.RELIABLE if is_reliable else QoSReliabilityPolicy.BEST_EFFORT,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL if topic.is_latched else QoSDurabilityPolicy.VOLATILE,
    )
