"""The network of ROS 2 by rclpy, where ROS 2 is sourced: for middlewares that `dds` does not support.

A node imports rclpy; this module can be imported without ROS 2. Tested with rclpy 7.1 (Jazzy) on Cyclone DDS.
"""

# pyright: reportMissingImports=false
# ROS 2 is no package of pip's.

from threading import Thread
from typing import Any, final

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.memory import MessageQueues
from pixel2catch.ros2.transport import Endpoint, Publisher, RealClock, Subscription, Topic, Transport

OWN_NODES = "pixel2catch"  #: Prefix of the names of our nodes, whose subscriptions only watch.


def join(node_name: str, clock: RealClock, _: str) -> Transport:
    """Join as a node of rclpy, with a thread that receives; raise ImportError if ROS 2 is not sourced."""
    import rclpy
    from rclpy.context import Context
    from rclpy.signals import SignalHandlerOptions
    from rclpy.subscription import Subscription as RclpySubscription

    if not hasattr(RclpySubscription, "CallbackType"):
        raise DeploymentError(
            "this rclpy does not give the time at which a message was sent, so that an old switch would "
            "count: use ROS 2 Iron or newer, or another --network."
        )
    context = Context()
    try:
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node(
            node_name, context=context, enable_rosout=False, start_parameter_services=False
        )
    except RuntimeError as error:
        rclpy.try_shutdown(context=context)
        raise DeploymentError(
            f"rclpy cannot join ({error}); check ROS_DOMAIN_ID, RMW_IMPLEMENTATION, "
            "ROS_SECURITY_KEYSTORE, ROS_SECURITY_ENCLAVE_OVERRIDE, and the settings of the middleware."
        ) from error
    return _RosTransport(node, context, clock)


@final
class _RosTransport(Transport):
    def __init__(self, node: Any, context: Any, clock: RealClock) -> None:
        from rclpy.executors import SingleThreadedExecutor

        self._node, self._context, self._clock = node, context, clock
        self._queues = MessageQueues(clock)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        self._is_open = True
        self._receiver = Thread(target=self._receive, name="rclpy", daemon=True)
        self._receiver.start()

    def publisher(self, topic: Topic) -> Publisher:
        publisher = self._node.create_publisher(_type(topic), topic.name, _qos(topic, 1, is_reader=False))
        return _RosPublisher(topic, self._node, publisher)

    def subscription(self, topic: Topic, depth: int = 1, *, only_watches: bool = False) -> Subscription:
        """Subscribe; others recognise a subscription that only watches by the name of its node."""
        queue = self._queues.add(topic, depth, only_watches=only_watches)
        qos = _qos(topic, depth, is_reader=True)

        def keep(data: bytes, info: dict[str, int]) -> None:
            # For a callback of two arguments, rclpy gives the time at which a message was sent [ns].
            queue.put(data, self._clock.age(info["source_timestamp"]))

        self._node.create_subscription(_type(topic), topic.name, keep, qos, raw=True)
        return queue

    def other_publishers(self, topic: Topic) -> dict[int, str]:
        """Return the publishers; messages do not name their sender."""
        found = self._node.get_publishers_info_by_topic(topic.name)
        others = (each for each in found if each.node_name != self._node.get_name())
        return {int.from_bytes(bytes(each.endpoint_gid)): f"node {each.node_name}" for each in others}

    def endpoints(self) -> list[Endpoint]:
        node = self._node
        both = ((node.get_publishers_info_by_topic, True), (node.get_subscriptions_info_by_topic, False))
        return [
            Endpoint(topic=name, type=each.topic_type, is_publisher=is_publisher, program=_program(each))
            for name, _ in node.get_topic_names_and_types()
            for list_of, is_publisher in both
            for each in list_of(name)
            if each.node_name != node.get_name()
            and (is_publisher or not each.node_name.startswith(OWN_NODES))
        ]

    def wait(self, seconds: float) -> bool:
        return self._queues.wait(seconds)

    def close(self) -> None:
        import rclpy

        if not self._is_open:
            return
        self._is_open = False
        self._executor.create_task(bool)  # ends the wait of the receiving thread
        self._receiver.join()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _receive(self) -> None:
        while self._is_open:
            self._executor.spin_once()


@final
class _RosPublisher(Publisher):
    def __init__(self, topic: Topic, node: Any, publisher: Any) -> None:
        self._topic, self._node, self._publisher = topic, node, publisher

    def publish(self, data: bytes) -> None:
        try:
            self._publisher.publish(data)
        except RuntimeError as error:
            raise DeploymentError(f"{self._topic.name} cannot be sent ({error}).") from error

    def num_subscribers(self) -> int:
        from rclpy.qos import QoSDurabilityPolicy

        latched = QoSDurabilityPolicy.TRANSIENT_LOCAL
        return len(
            {
                _program(each)
                for each in self._node.get_subscriptions_info_by_topic(self._topic.name)
                if not each.node_name.startswith(OWN_NODES)
                and each.topic_type == self._topic.type
                and self._topic.is_latched >= (each.qos_profile.durability == latched)
            }
        )


def _program(endpoint: Any) -> str:
    """Return the participant of an endpoint: the first twelve bytes of its identifier.

    Source: DDS-RTPS, GuidPrefix. A middleware that is no DDS may give each endpoint another prefix.
    """
    return bytes(endpoint.endpoint_gid)[:12].hex()


def _type(topic: Topic) -> Any:
    from rosidl_runtime_py.utilities import get_message

    try:
        return get_message(topic.type)
    except (AttributeError, ModuleNotFoundError, ValueError) as error:
        package = topic.type.partition("/")[0]
        message = f"{topic.name}: ROS 2 has no {topic.type} ({error}): install {package}."
        raise DeploymentError(message) from error


def _qos(topic: Topic, depth: int, *, is_reader: bool) -> Any:
    """Return the qualities of an endpoint: best effort to receive from every publisher, else reliable."""
    from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy

    is_best_effort = is_reader and not topic.is_latched
    return QoSProfile(
        depth=depth,
        reliability=QoSReliabilityPolicy.BEST_EFFORT if is_best_effort else QoSReliabilityPolicy.RELIABLE,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL if topic.is_latched else QoSDurabilityPolicy.VOLATILE,
    )
