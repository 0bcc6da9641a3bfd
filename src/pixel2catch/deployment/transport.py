"""How messages travel: the interface to DDS, ROS 2, bags and memory, in serialised messages (CDR).

Nothing here waits but `Transport.wait`; what arrives is kept until it is taken, up to a depth.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Topic:
    """What is published under a name.

    Attributes:
        name: ROS name, such as "/joint_states".
        type: ROS type, such as "sensor_msgs/msg/JointState".
        is_latched: Whether late subscribers get the last message (transient local, reliable).
    """

    name: str
    type: str
    is_latched: bool = False


@dataclass(frozen=True, kw_only=True)
class Packet:
    """One message as it arrived.

    Attributes:
        data: CDR, with its header of four bytes.
        arrival: When it was received, `Clock.now` [s].
    """

    data: bytes
    arrival: float


class Publisher(ABC):
    """Sends messages of one topic."""

    @abstractmethod
    def publish(self, data: bytes) -> None:
        """Send a serialised message."""


class Subscription(ABC):
    """Receives messages of one topic."""

    @abstractmethod
    def take(self) -> list[Packet]:
        """What arrived since the last call, oldest first; of more than the depth the oldest are lost."""


class Transport(ABC):
    """A node of the network; close it, or use it as a context manager."""

    @abstractmethod
    def publisher(self, topic: Topic) -> Publisher:
        """Announce a topic that this node sends."""

    @abstractmethod
    def subscription(self, topic: Topic, depth: int = 1) -> Subscription:
        """Begin to listen to a topic.

        Args:
            topic: The topic.
            depth: Messages that are kept until they are taken.
        """

    @abstractmethod
    def num_other_publishers(self, topic: Topic) -> int:
        """How many publishers of a topic there are besides those of this node."""

    @abstractmethod
    def wait(self, seconds: float) -> bool:
        """Wait until something has arrived for any subscription, or for a real time [s]; say which."""

    @abstractmethod
    def close(self) -> None:
        """Leave the network."""

    def __enter__(self) -> "Transport":
        """Return the node itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()
