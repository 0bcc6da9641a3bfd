"""How messages travel: the interface to DDS, ROS 2, recordings and memory, in serialised messages (CDR).

Only `Transport.wait` blocks. Messages that arrive are kept until they are taken, up to a depth.
"""

import os
import socket
import time
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, final

from pixel2catch.checks import Meets
from pixel2catch.errors import DeploymentError, UnknownNameError
from pixel2catch.installation import install_command

POLL_TIME = 0.2  #: Time between two counts of publishers, subscribers or cameras [s]. Source: ours.


class Clock(ABC):
    """Time that all processes of a deployment share."""

    @abstractmethod
    def now(self) -> float:
        """Return the monotonic time [s], for ages, periods and deadlines."""

    @abstractmethod
    def stamp(self) -> float:
        """Return the time of day [s], for headers of messages."""

    @abstractmethod
    def sleep_until(self, moment: float) -> None:
        """Wait for a time of `now`; return at once if it has passed."""


_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


@final
class RealClock(Clock):
    """Real time, equal in all processes of a machine, at a stated rate.

    It advances while the machine is suspended, so that a switch held before does not count after it.
    """

    def __init__(self, rate: float = 1.0) -> None:
        """Set the rate: 1 for a robot, less where a twin is too slow."""
        self.rate = rate

    def now(self) -> float:
        return self.rate * time.clock_gettime(_CLOCK)

    def stamp(self) -> float:
        return self.rate * time.time()

    def age(self, sent: int) -> float:
        """Return the time since a sender's stamp, in nanoseconds since the epoch [s]."""
        return self.stamp() - 1e-9 * self.rate * sent

    def sleep_until(self, moment: float) -> None:
        left = (moment - self.now()) / self.rate
        if left > 0.0:
            time.sleep(left)


@dataclass(frozen=True, kw_only=True)
class Topic:
    """A name under which messages of one type are sent."""

    name: str  #: ROS name, such as "/joint_states".
    type: str  #: ROS type, such as "sensor_msgs/msg/JointState".
    is_latched: bool = False  #: Whether late subscribers get the last message (transient local, reliable).


@dataclass(frozen=True, kw_only=True)
class Message:
    """A message as it arrived."""

    data: bytes  #: CDR, with its header of four bytes.
    arrival: float  #: Time of arrival, `Clock.now` [s].
    age: float = 0.0  #: Time between sending, by the sender's clock, and arrival [s]; 0 if unknown.
    sender: int = 0  #: Its publisher, a key of `Transport.other_publishers`; 0 if unknown.


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """A publisher or subscription of another program."""

    topic: str  #: ROS name.
    type: str  #: ROS type.
    is_publisher: bool
    program: str  #: Its DDS participant: a program may have several endpoints of a topic.


class Publisher(ABC):
    """Sends messages of one topic."""

    @abstractmethod
    def publish(self, data: bytes) -> None:
        """Send a serialised message."""

    @abstractmethod
    def num_subscribers(self) -> int:
        """Return the number of programs (DDS participants) that receive its messages, not only watch them."""


class Subscription(ABC):
    """Receives messages of one topic."""

    @abstractmethod
    def take(self) -> list[Message]:
        """Return the messages since the last call, oldest first; beyond the depth, the oldest are lost."""


class Transport(AbstractContextManager["Transport"]):
    """A node of the network; close it, or use it as a context manager."""

    @abstractmethod
    def publisher(self, topic: Topic) -> Publisher:
        """Announce a topic that this node sends."""

    @abstractmethod
    def subscription(self, topic: Topic, depth: int = 1, *, only_watches: bool = False) -> Subscription:
        """Subscribe to a topic, and keep up to `depth` messages until they are taken.

        A subscription that only watches is not counted, and does not end a `wait`, as for a recording.
        """

    def num_other_publishers(self, topic: Topic) -> int:
        """Return the number of publishers of a topic, without those of this node."""
        return len(self.other_publishers(topic))

    @abstractmethod
    def other_publishers(self, topic: Topic) -> dict[int, str]:
        """Return these publishers with a description, as far as known: program, process and machine."""

    @abstractmethod
    def endpoints(self) -> list[Endpoint]:
        """Return the known publishers and subscriptions of other nodes, without those that only watch."""

    @abstractmethod
    def wait(self, seconds: float) -> bool:
        """Wait up to a real time for a message [s]; return whether there is one."""

    @abstractmethod
    def close(self) -> None:
        """Leave the network."""

    def __exit__(self, *exception: object) -> None:
        self.close()


LOOPBACK, ANY, ROS = "lo", "any", "ros"
"""Networks besides the interfaces of this machine: this machine only, the choice of DDS, and rclpy's."""


def _is_known(network: str) -> bool:
    """Return whether this machine has a network; raise UnknownNameError with those that it has."""
    known = dict.fromkeys((LOOPBACK, *(name for _, name in socket.if_nameindex()), ANY, ROS))
    if network not in known:
        raise UnknownNameError("network", network, known)
    return True


NetworkName = Annotated[str, Meets(_is_known, "name a network")]
"""`LOOPBACK`, an interface of this machine, `ANY` or `ROS`."""


def make_transport(node_name: str, network: str, clock: RealClock) -> Transport:
    """Join a network, a `NetworkName`, by rclpy if it is `ROS`, else by DDS.

    Raises DeploymentError if that cannot be started or its library is missing, or SROS 2 is on elsewhere.
    """
    if os.environ.get("ROS_SECURITY_ENABLE") == "true" and network not in (ROS, LOOPBACK):
        fix = "give --network ros, or unset it"
        raise DeploymentError(f"'{network}' does not support ROS_SECURITY_ENABLE, which is true: {fix}.")
    module, remedy = "dds", install_command("deployment")
    if network == ROS:
        remedy = "source ROS 2 (. /opt/ros/*/setup.sh) and use its Python, or another --network"
        module = "rclpy_node"
    try:  # imported here, as the libraries may be missing
        return import_module(f"pixel2catch.ros2.{module}").join(node_name, clock, network)
    except ImportError as error:
        raise DeploymentError(f"the network '{network}' cannot be joined ({error}): {remedy}.") from error
