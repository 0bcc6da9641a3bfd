"""Nodes of one process that exchange messages in memory, by the rules of DDS: for rehearsals and tests."""

from collections import deque
from collections.abc import Iterator
from itertools import count
from threading import Condition, RLock
from typing import NamedTuple, final

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.transport import Clock, Endpoint, Message, Publisher, Subscription, Topic, Transport


@final
class MessageQueue(Subscription):
    """The messages of one subscription; `MessageQueues` makes it. Any thread may use it."""

    def __init__(self, clock: Clock, arrived: Condition, depth: int) -> None:
        """Begin empty."""
        self._clock, self._arrived = clock, arrived
        self._waiting: deque[Message] = deque(maxlen=depth)

    def put(self, data: bytes, age: float = 0.0, sender: int = 0) -> None:
        """Add a message that arrives now; its age is the time since it was sent [s]."""
        with self._arrived:
            self._waiting.append(Message(data=data, arrival=self._clock.now(), age=age, sender=sender))
            self._arrived.notify_all()

    def take(self) -> list[Message]:
        """See `Subscription.take`."""
        with self._arrived:
            received = list(self._waiting)
            self._waiting.clear()
        return received

    def __bool__(self) -> bool:
        """Return whether there is a message."""
        return bool(self._waiting)


class MessageQueues:
    """The queues of a node; the clock gives the arrival of messages."""

    def __init__(self, clock: Clock) -> None:
        """Begin without queues."""
        self._clock, self._arrived = clock, Condition()
        self._queues: list[MessageQueue] = []

    def add(self, depth: int, *, only_watches: bool = False) -> MessageQueue:
        """Make a queue; see `Transport.subscription`."""
        queue = MessageQueue(self._clock, self._arrived, depth)
        if not only_watches:
            self._queues.append(queue)
        return queue

    def wait(self, seconds: float) -> bool:
        """See `Transport.wait`."""
        with self._arrived:
            return self._arrived.wait_for(lambda: any(self._queues), timeout=seconds)


class Broker:
    """The network of some nodes. Any thread may use it."""

    def __init__(self) -> None:
        """Begin without nodes."""
        self.lock, self.numbers = RLock(), count(1)
        self.nodes: list[MemoryTransport] = []

    def node(self, clock: Clock) -> "MemoryTransport":
        """Add a node; the clock gives the arrival of its messages."""
        node = MemoryTransport(self, clock)
        with self.lock:
            self.nodes.append(node)
        return node


class _Listener(NamedTuple):
    topic: Topic
    queue: MessageQueue
    only_watches: bool


@final
class MemoryTransport(Transport):
    """A node of a broker; `Broker.node` makes it."""

    def __init__(self, broker: Broker, clock: Clock) -> None:
        """Begin without publishers and subscriptions."""
        self.broker, self._queues = broker, MessageQueues(clock)
        self.publishers: list[_MemoryPublisher] = []
        self.listeners: list[_Listener] = []

    def publisher(self, topic: Topic) -> Publisher:
        """See `Transport.publisher`."""
        publisher = _MemoryPublisher(self, topic)
        with self.broker.lock:
            self.publishers.append(publisher)
        return publisher

    def subscription(self, topic: Topic, depth: int = 1, *, only_watches: bool = False) -> Subscription:
        """See `Transport.subscription`."""
        queue = self._queues.add(depth, only_watches=only_watches)
        with self.broker.lock:
            self.listeners.append(_Listener(topic, queue, only_watches))
            for publisher in (each for node in self.broker.nodes for each in node.publishers):
                if publisher.last is not None and topic.is_latched and _fits(publisher.topic, topic):
                    queue.put(publisher.last, sender=publisher.number)
        return queue

    def num_other_publishers(self, topic: Topic) -> int:
        """See `Transport.num_other_publishers`."""
        return len(self.other_publishers(topic))

    def other_publishers(self, topic: Topic) -> dict[int, str]:
        """See `Transport.other_publishers`."""
        with self.broker.lock:
            others = (each for node in self.broker.nodes if node is not self for each in node.publishers)
            return {each.number: f"publisher {each.number}" for each in others if _is_same(each.topic, topic)}

    def endpoints(self) -> list[Endpoint]:
        """See `Transport.endpoints`."""
        with self.broker.lock:
            others = [node for node in self.broker.nodes if node is not self]
            found = [(each.topic, True) for node in others for each in node.publishers]
            listeners = (each for node in others for each in node.listeners if not each.only_watches)
            found += [(each.topic, False) for each in listeners]
        return [Endpoint(topic=topic.name, type=topic.type, is_publisher=sends) for topic, sends in found]

    def wait(self, seconds: float) -> bool:
        """See `Transport.wait`."""
        return self._queues.wait(seconds)

    def close(self) -> None:
        """See `Transport.close`."""
        with self.broker.lock:
            self.broker.nodes = [node for node in self.broker.nodes if node is not self]


@final
class _MemoryPublisher(Publisher):
    def __init__(self, node: MemoryTransport, topic: Topic) -> None:
        self._node, self.topic = node, topic
        self.number = next(node.broker.numbers)
        self.last: bytes | None = None

    def publish(self, data: bytes) -> None:
        broker = self._node.broker
        with broker.lock:
            if self._node not in broker.nodes:
                raise DeploymentError(f"{self.topic.name} cannot be sent: its node is closed.")
            self.last = data
            for listener in self._listeners():
                listener.queue.put(data, sender=self.number)

    def num_subscribers(self) -> int:
        with self._node.broker.lock:
            return sum(not listener.only_watches for listener in self._listeners())

    def _listeners(self) -> Iterator[_Listener]:
        listeners = (each for node in self._node.broker.nodes for each in node.listeners)
        return (each for each in listeners if _fits(self.topic, each.topic))


def _is_same(one: Topic, other: Topic) -> bool:
    return (one.name, one.type) == (other.name, other.type)


def _fits(offered: Topic, requested: Topic) -> bool:
    """Return whether DDS would connect them: latched messages need a publisher that keeps them."""
    return _is_same(offered, requested) and (offered.is_latched or not requested.is_latched)
