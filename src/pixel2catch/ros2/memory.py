"""Nodes of one process that talk to each other through memory, by the rules of DDS: for tests."""

from collections import deque
from dataclasses import dataclass
from threading import Condition, RLock
from typing import final

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.transport import Clock, Message, Publisher, Subscription, Topic, Transport


@final
class MessageQueue(Subscription):
    """The messages of one subscription; made by `MessageQueues`."""

    def __init__(self, clock: Clock, arrived: Condition, depth: int) -> None:
        """Begin empty."""
        self._clock, self._arrived = clock, arrived
        self._packets: deque[Message] = deque(maxlen=depth)

    def put(self, data: bytes) -> None:
        """Keep a message that has just arrived; any thread may call this."""
        with self._arrived:
            self._packets.append(Message(data=data, arrival=self._clock.now()))
            self._arrived.notify_all()

    def take(self) -> list[Message]:
        """What arrived since the last call, oldest first; of more than the depth the oldest are lost."""
        with self._arrived:
            received = list(self._packets)
            self._packets.clear()
        return received

    def __bool__(self) -> bool:
        """Return whether a message waits."""
        return bool(self._packets)


class MessageQueues:
    """All inboxes of a node, and the wait for any of them.

    Args:
        clock: Tells when a message arrives.
    """

    def __init__(self, clock: Clock) -> None:
        """Begin with none."""
        self._clock, self._arrived = clock, Condition()
        self._queues: list[MessageQueue] = []

    def add(self, depth: int) -> MessageQueue:
        """Make one that keeps so many messages."""
        queue = MessageQueue(self._clock, self._arrived, depth)
        self._queues.append(queue)
        return queue

    def wait(self, seconds: float) -> bool:
        """Wait until there is a message in any of them, or for a real time [s]; say which."""
        with self._arrived:
            return self._arrived.wait_for(lambda: any(self._queues), timeout=seconds)


@dataclass(frozen=True, eq=False)
class _Listener:
    node: "MemoryTransport"
    topic: Topic
    queue: MessageQueue


class Broker:
    """The network: make all nodes on the same one. Any thread may use it."""

    def __init__(self) -> None:
        """Begin without nodes."""
        self._lock = RLock()
        self._publishers: list[_MemoryPublisher] = []
        self._listeners: list[_Listener] = []

    def node(self, clock: Clock) -> "MemoryTransport":
        """Make a node.

        Args:
            clock: Tells when its messages arrive.
        """
        return MemoryTransport(self, clock)

    def announce(self, publisher: "_MemoryPublisher") -> None:
        """Add a publisher."""
        with self._lock:
            self._publishers.append(publisher)

    def listen(self, listener: _Listener) -> None:
        """Add a subscription; one of a latched topic gets the last messages."""
        with self._lock:
            self._listeners.append(listener)
            for publisher in self._publishers:
                if publisher.last is not None and listener.topic.is_latched and _fits(publisher, listener):
                    listener.queue.put(publisher.last)

    def deliver(self, publisher: "_MemoryPublisher", data: bytes) -> None:
        """Bring a message to all that listen.

        Raises:
            DeploymentError: The publisher's node is closed.
        """
        with self._lock:
            if publisher not in self._publishers:
                raise DeploymentError(f"{publisher.topic.name} cannot be sent: its node is closed.")
            publisher.last = data
            for listener in self._listeners:
                if _fits(publisher, listener):
                    listener.queue.put(data)

    def num_publishers(self, topic: Topic, without: "MemoryTransport") -> int:
        """How many publishers of a topic there are, one node's left out."""
        with self._lock:
            others = [publisher for publisher in self._publishers if publisher.node is not without]
            return sum(_is_same(publisher.topic, topic) for publisher in others)

    def leave(self, node: "MemoryTransport") -> None:
        """Remove all that a node has."""
        with self._lock:
            self._publishers = [publisher for publisher in self._publishers if publisher.node is not node]
            self._listeners = [listener for listener in self._listeners if listener.node is not node]


@final
class _MemoryPublisher(Publisher):
    def __init__(self, broker: Broker, node: "MemoryTransport", topic: Topic) -> None:
        self._broker = broker
        self.node, self.topic = node, topic
        self.last: bytes | None = None

    def publish(self, data: bytes) -> None:
        self._broker.deliver(self, data)


@final
class MemoryTransport(Transport):
    """A node on a broker, which makes it."""

    def __init__(self, broker: Broker, clock: Clock) -> None:
        """Join."""
        self._broker, self._queues = broker, MessageQueues(clock)

    def publisher(self, topic: Topic) -> Publisher:
        """Announce a topic that this node sends."""
        publisher = _MemoryPublisher(self._broker, self, topic)
        self._broker.announce(publisher)
        return publisher

    def subscription(self, topic: Topic, depth: int = 1) -> Subscription:
        """Begin to listen to a topic."""
        queue = self._queues.add(depth)
        self._broker.listen(_Listener(self, topic, queue))
        return queue

    def num_other_publishers(self, topic: Topic) -> int:
        """How many publishers of a topic there are besides those of this node."""
        return self._broker.num_publishers(topic, without=self)

    def wait(self, seconds: float) -> bool:
        """Wait until a message can be taken, or for a real time [s]; say which."""
        return self._queues.wait(seconds)

    def close(self) -> None:
        """Leave the broker."""
        self._broker.leave(self)


def _is_same(one: Topic, other: Topic) -> bool:
    return (one.name, one.type) == (other.name, other.type)


def _fits(publisher: _MemoryPublisher, listener: _Listener) -> bool:
    """Whether DDS would match the two: who asks for latched messages needs a publisher that keeps them."""
    is_offered = publisher.topic.is_latched or not listener.topic.is_latched
    return _is_same(publisher.topic, listener.topic) and is_offered
