"""Messages that wait in memory until they are taken: for transports that are called back."""

from collections import deque
from threading import Condition
from typing import final

from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.transport import Packet, Subscription


@final
class Inbox(Subscription):
    """The messages of one subscription; made by `Inboxes`."""

    def __init__(self, clock: Clock, arrived: Condition, depth: int) -> None:
        """Begin empty."""
        self._clock, self._arrived = clock, arrived
        self._packets: deque[Packet] = deque(maxlen=depth)

    def put(self, data: bytes) -> None:
        """Keep a message that has just arrived; any thread may call this."""
        with self._arrived:
            self._packets.append(Packet(data=data, arrival=self._clock.now()))
            self._arrived.notify_all()

    def take(self) -> list[Packet]:
        """What arrived since the last call, oldest first; of more than the depth the oldest are lost."""
        with self._arrived:
            packets = list(self._packets)
            self._packets.clear()
        return packets

    def __bool__(self) -> bool:
        """Return whether a message waits."""
        return bool(self._packets)


class Inboxes:
    """All inboxes of a node, and the wait for any of them.

    Args:
        clock: Tells when a message arrives.
    """

    def __init__(self, clock: Clock) -> None:
        """Begin with none."""
        self._clock, self._arrived = clock, Condition()
        self._inboxes: list[Inbox] = []

    def add(self, depth: int) -> Inbox:
        """Make one that keeps so many messages."""
        inbox = Inbox(self._clock, self._arrived, depth)
        self._inboxes.append(inbox)
        return inbox

    def wait(self, seconds: float) -> bool:
        """Wait until there is a message in any of them, or for a real time [s]; say which."""
        with self._arrived:
            return self._arrived.wait_for(lambda: any(self._inboxes), timeout=seconds)
