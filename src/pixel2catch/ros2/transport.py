"""How messages travel: the interface to DDS, ROS 2, bags and memory, in serialised messages (CDR).

Nothing here waits but `Transport.wait`; what arrives is kept until it is taken, up to a depth.
"""

import socket
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, final

from pixel2catch.checks import Requirement
from pixel2catch.errors import InvalidValueError, UnknownNameError


class Clock(ABC):
    """Seconds that everything which takes part in a deployment agrees on."""

    @abstractmethod
    def now(self) -> float:
        """Monotonic time [s]: for ages, periods and deadlines."""

    @abstractmethod
    def stamp(self) -> float:
        """Time of day [s]: for the headers of messages, which other machines compare with their own."""

    @abstractmethod
    def sleep_until(self, moment: float) -> None:
        """Wait for a moment of `now`; return at once if it is over."""


POLL_TIME = 0.2  #: Time between two counts of publishers, subscribers or cameras [s]. Source: ours.
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


@final
class RealClock(Clock):
    """Seconds that pass at a stated rate, the same ones in every process of one machine.

    They pass, too, while the machine is suspended: whoever held the switch before does not hold it after.
    """

    def __init__(self, rate: float = 1.0) -> None:
        """Begin, with so many seconds in a real one: 1 for a robot, less where a twin is too slow.

        Raises:
            InvalidValueError: The rate is out of range.
        """
        if not 0.0 < rate <= 1.0:
            raise InvalidValueError(f"the clock's rate is {rate:g}; it must be more than 0 and at most 1")
        self.rate = rate

    def now(self) -> float:
        """See `Clock.now`."""
        return self.rate * time.clock_gettime(_CLOCK)

    def stamp(self) -> float:
        """See `Clock.stamp`."""
        return self.rate * time.time()

    def age(self, sent: int) -> float:
        """How long ago it was that a sender's real clock showed a time since the epoch [ns]: seconds."""
        return self.stamp() - 1e-9 * self.rate * sent

    def sleep_until(self, moment: float) -> None:
        """See `Clock.sleep_until`."""
        left = (moment - self.now()) / self.rate
        if left > 0.0:
            time.sleep(left)


@dataclass(frozen=True, kw_only=True)
class Topic:
    """What is published under a name."""

    name: str  #: ROS name, such as "/joint_states".
    type: str  #: ROS type, such as "sensor_msgs/msg/JointState".
    is_latched: bool = False  #: Whether late subscribers get the last message (transient local, reliable).


@dataclass(frozen=True, kw_only=True)
class Message:
    """One message as it arrived."""

    data: bytes  #: CDR, with its header of four bytes.
    arrival: float  #: When it was received, `Clock.now` [s].
    age: float = 0.0  #: How long before it was sent, by the sender's clock [s]; 0 where that is not told.
    sender: int = 0  #: Its publisher, a key of `Transport.other_publishers`; 0 where that is not told.


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """A publisher or a subscription of another program."""

    topic: str  #: ROS name.
    type: str  #: ROS type.
    is_publisher: bool  #: Whether it sends; else it receives.


class Publisher(ABC):
    """Sends messages of one topic."""

    @abstractmethod
    def publish(self, data: bytes) -> None:
        """Send a serialised message."""

    @abstractmethod
    def num_subscribers(self) -> int:
        """How many subscriptions take its messages, those left out that only watch."""


class Subscription(ABC):
    """Receives messages of one topic."""

    @abstractmethod
    def take(self) -> list[Message]:
        """What arrived since the last call, oldest first; of more than the depth the oldest are lost."""


class Transport(ABC):
    """A node of the network; close it, or use it as a context manager."""

    @abstractmethod
    def publisher(self, topic: Topic) -> Publisher:
        """Announce a topic that this node sends."""

    @abstractmethod
    def subscription(self, topic: Topic, depth: int = 1, *, only_watches: bool = False) -> Subscription:
        """Begin to listen to a topic; so many messages are kept until they are taken.

        One that only watches, such as a recording's, does not count as a subscriber, and is not awaited: its
        messages end no `wait`.
        """

    @abstractmethod
    def num_other_publishers(self, topic: Topic) -> int:
        """How many publishers of a topic there are besides those of this node."""

    @abstractmethod
    def other_publishers(self, topic: Topic) -> dict[int, str]:
        """Those publishers, in words as far as the network tells: program, process and machine."""

    @abstractmethod
    def endpoints(self) -> list[Endpoint]:
        """The publishers and subscriptions of all other nodes that are known by now; nothing is announced.

        Subscriptions that only watch are left out.
        """

    @abstractmethod
    def wait(self, seconds: float) -> bool:
        """Wait until something that is awaited has arrived, or for a real time [s]; say which."""

    @abstractmethod
    def close(self) -> None:
        """Leave the network."""

    def __enter__(self) -> "Transport":
        """Return the node itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()


LOOPBACK, ANY = "lo", "any"
"""Networks besides the interfaces of this machine: itself alone, and what the transport takes by itself."""

ROS_ON_LOOPBACK = {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
"""What keeps ROS 2 to this machine, the older setting first."""


@final
@dataclass(frozen=True)
class Reachable(Requirement):
    """A network that this machine is on."""

    def require(self, name: str, value: str) -> None:
        """Refuse an interface that there is not, and name those that there are."""
        known = dict.fromkeys((LOOPBACK, *(interface for _, interface in socket.if_nameindex()), ANY))
        if value not in known:
            raise UnknownNameError(name, value, known)


NetworkName = Annotated[str, Reachable()]
"""`LOOPBACK`, an interface of this machine, or `ANY`."""
