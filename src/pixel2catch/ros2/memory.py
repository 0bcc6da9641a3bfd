"""Nodes of one process that talk to each other through memory, by the rules of DDS: for tests."""

from collections import deque
from collections.abc import Iterator
from itertools import count
from threading import Condition, RLock
from typing import NamedTuple, final

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.transport import Clock, Endpoint, Message, Publisher, Subscription, Topic, Transport


@final
class MessageQueue(Subscription):
    """The messages of one subscription; made by `MessageQueues`."""

    def __init__(self, clock: Clock, arrived: Condition, depth: int) -> None:
        """Begin empty."""
        self._clock, self._arrived = clock, arrived
        self._waiting: deque[Message] = deque(maxlen=depth)

    def put(self, data: bytes, age: float = 0.0, sender: int = 0) -> None:
        """Keep a message that has just arrived, some time [s] after it was sent; any thread may call this."""
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
        """Return whether a message waits."""
        return bool(self._waiting)


class MessageQueues:
    """What makes the queues of a node, and the wait for them; the clock tells when a message arrives."""

    def __init__(self, clock: Clock) -> None:
        """Begin with none."""
        self._clock, self._arrived = clock, Condition()
        self._queues: list[MessageQueue] = []

    def add(self, depth: int, *, is_awaited: bool = True) -> MessageQueue:
        """Make one that keeps so many messages, and is waited for or not."""
        queue = MessageQueue(self._clock, self._arrived, depth)
        if is_awaited:
            self._queues.append(queue)
        return queue

    def wait(self, seconds: float) -> bool:
        """Wait until there is a message in any that is waited for, or for a real time [s]; say which."""
        with self._arrived:
            return self._arrived.wait_for(lambda: any(self._queues), timeout=seconds)


class Broker:
    """The network: make all nodes on the same one. Any thread may use it."""

    def __init__(self) -> None:
        """Begin without nodes."""
        self.lock, self.numbers = RLock(), count(1)
        self.nodes: list[MemoryTransport] = []

    def node(self, clock: Clock) -> "MemoryTransport":
        """Make a node; the clock tells when its messages arrive."""
        node = MemoryTransport(self, clock)
        with self.lock:
            self.nodes.append(node)
        return node


@final
class MemoryTransport(Transport):
    """A node on a broker, which makes it."""

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
        """Begin to listen to a topic; one that is latched gives its last messages."""
        queue = self._queues.add(depth, is_awaited=not only_watches)
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
        return [
            Endpoint(topic=topic.name, type=topic.type, is_publisher=is_publisher)
            for topic, is_publisher in found
        ]

    def wait(self, seconds: float) -> bool:
        """See `Transport.wait`."""
        return self._queues.wait(seconds)

    def close(self) -> None:
        """Leave the broker."""
        with self.broker.lock:
            self.broker.nodes = [node for node in self.broker.nodes if node is not self]


class _Listener(NamedTuple):
    topic: Topic
    queue: MessageQueue
    only_watches: bool


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

    def _listeners(self) -> "Iterator[_Listener]":
        """All that hear it."""
        listeners = (each for node in self._node.broker.nodes for each in node.listeners)
        return (each for each in listeners if _fits(self.topic, each.topic))


def _is_same(one: Topic, other: Topic) -> bool:
    return (one.name, one.type) == (other.name, other.type)


def _fits(offered: Topic, wanted: Topic) -> bool:
    """Whether DDS would match the two: who asks for latched messages needs a publisher that keeps them."""
    return _is_same(offered, wanted) and (offered.is_latched or not wanted.is_latched)
