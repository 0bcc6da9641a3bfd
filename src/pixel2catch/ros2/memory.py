"""Nodes of one process that exchange messages in memory, by the rules of DDS: for rehearsals and tests."""

from collections import deque
from itertools import count
from threading import Condition, RLock
from typing import final

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.transport import Clock, Endpoint, Message, Publisher, Subscription, Topic, Transport


@final
class MessageQueue(Subscription):
    """The messages of one subscription; `MessageQueues` makes it. Any thread may use it."""

    def __init__(self, node: "MessageQueues", topic: Topic, depth: int, only_watches: bool) -> None:
        self._node, self.topic, self.only_watches = node, topic, only_watches
        self.waiting: deque[Message] = deque(maxlen=depth)  #: Messages until they are taken.

    def put(self, data: bytes, age: float = 0.0, sender: int = 0) -> None:
        """Add a message that arrives now; its age is the time since it was sent [s]."""
        with self._node.arrived:
            self.waiting.append(Message(data=data, arrival=self._node.clock.now(), age=age, sender=sender))
            self._node.arrived.notify_all()

    def take(self) -> list[Message]:
        with self._node.arrived:
            received = list(self.waiting)
            self.waiting.clear()
        return received


class MessageQueues(list[MessageQueue]):
    """The queues of a node; the clock gives the arrival of messages."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock, self.arrived = clock, Condition()

    def add(self, topic: Topic, depth: int, *, only_watches: bool) -> MessageQueue:
        self.append(MessageQueue(self, topic, depth, only_watches))
        return self[-1]

    def wait(self, seconds: float) -> bool:
        queues = [each.waiting for each in self if not each.only_watches]
        with self.arrived:
            return self.arrived.wait_for(lambda: any(queues), timeout=seconds)


class Broker:
    """The network of some nodes. Any thread may use it."""

    def __init__(self) -> None:
        self.lock, self.numbers = RLock(), count(1)
        self.nodes: list[MemoryTransport] = []

    def node(self, clock: Clock) -> "MemoryTransport":
        """Add a node; the clock gives the arrival of its messages."""
        with self.lock:
            self.nodes.append(MemoryTransport(self, clock))
            return self.nodes[-1]


@final
class MemoryTransport(Transport):
    """A node of a broker; `Broker.node` makes it."""

    def __init__(self, broker: Broker, clock: Clock) -> None:
        self.broker, self.queues = broker, MessageQueues(clock)
        self.publishers: list[_MemoryPublisher] = []

    def publisher(self, topic: Topic) -> Publisher:
        with self.broker.lock:
            self.publishers.append(_MemoryPublisher(self, topic))
            return self.publishers[-1]

    def subscription(self, topic: Topic, depth: int = 1, *, only_watches: bool = False) -> Subscription:
        with self.broker.lock:
            queue = self.queues.add(topic, depth, only_watches=only_watches)
            for publisher in (each for node in self.broker.nodes for each in node.publishers):
                if publisher.last is not None and topic.is_latched and publisher.reaches(queue):
                    queue.put(publisher.last, sender=publisher.number)
        return queue

    @property
    def _others(self) -> list["MemoryTransport"]:
        with self.broker.lock:
            return [node for node in self.broker.nodes if node is not self]

    def other_publishers(self, topic: Topic) -> dict[int, str]:
        others = (each for node in self._others for each in node.publishers)
        return {each.number: f"publisher {each.number}" for each in others if _is_same(each.topic, topic)}

    def endpoints(self) -> list[Endpoint]:
        ends = [(node, each.topic, True) for node in self._others for each in node.publishers]
        ends += [(node, q.topic, False) for node in self._others for q in node.queues if not q.only_watches]
        return [
            Endpoint(topic=topic.name, type=topic.type, is_publisher=is_publisher, program=str(id(node)))
            for node, topic, is_publisher in ends
        ]

    def wait(self, seconds: float) -> bool:
        return self.queues.wait(seconds)

    def close(self) -> None:
        with self.broker.lock:
            self.broker.nodes = self._others


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
            for queue in (each for node in broker.nodes for each in node.queues if self.reaches(each)):
                queue.put(data, sender=self.number)

    def num_subscribers(self) -> int:
        with self._node.broker.lock:
            counted = [[q for q in node.queues if not q.only_watches] for node in self._node.broker.nodes]
            return sum(any(map(self.reaches, queues)) for queues in counted)

    def reaches(self, queue: MessageQueue) -> bool:
        """Return whether DDS would connect them: latched messages need a publisher that keeps them."""
        return _is_same(self.topic, queue.topic) and self.topic.is_latched >= queue.topic.is_latched


def _is_same(one: Topic, other: Topic) -> bool:
    return (one.name, one.type) == (other.name, other.type)
