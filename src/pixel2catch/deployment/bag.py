"""A recording as a network: its messages come again as they came. Needs rosbags."""

import struct
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from typing import final

from pixel2catch.deployment.clock import RealClock
from pixel2catch.deployment.inbox import Inbox, Inboxes
from pixel2catch.deployment.messages import CAMERA_INFO, IMAGE, JOINT_STATE
from pixel2catch.deployment.transport import Packet, Publisher, Subscription, Topic, Transport
from pixel2catch.errors import Pixel2CatchError
from pixel2catch.perception.rosbag_images import opened_bag

STAMPED = (CAMERA_INFO, IMAGE, JOINT_STATE)
"""Types that begin with a header."""


@final
class ReplayTransport(Transport):
    """Plays a rosbag2 in its own time, from the first `take` or `wait` on; what is published goes nowhere.

    Headers get the stamps that they would have if all happened now.

    Attributes:
        is_over: Whether all messages have come.
        problem: What ended it early; empty if nothing did.
    """

    def __init__(self, path: Path, clock: RealClock) -> None:
        """Open a recording.

        Args:
            path: The bag's folder, or its .mcap or .db3 file.
            clock: Its time.

        Raises:
            PerceptionError: It cannot be read.
        """
        with opened_bag(path):
            pass
        self.is_over, self.problem = False, ""
        self._path, self._clock = path, clock
        self._inboxes = Inboxes(clock)
        self._listeners: dict[tuple[str, str], list[Inbox]] = {}
        self._is_closed = Event()
        self._player = Thread(target=self._play, name="replay", daemon=True)

    def publisher(self, topic: Topic) -> Publisher:
        """Announce a topic; nobody hears it."""
        del topic
        return _Silence()

    def subscription(self, topic: Topic, depth: int = 1) -> Subscription:
        """Begin to listen to a recorded topic."""
        inbox = self._inboxes.add(depth)
        self._listeners.setdefault((topic.name, topic.type), []).append(inbox)
        return _Replayed(inbox, self._begin)

    def num_other_publishers(self, topic: Topic) -> int:
        """None: the recorded commands are not sent."""
        del topic
        return 0

    def wait(self, seconds: float) -> bool:
        """Wait until a message can be taken, or for a real time [s]; say which."""
        self._begin()
        return self._inboxes.wait(seconds)

    def close(self) -> None:
        """Stop to play."""
        self._is_closed.set()
        if self._player.is_alive():
            self._player.join()

    def _begin(self) -> None:
        if self._player.ident is None:
            self._player.start()

    def _play(self) -> None:
        try:
            self._play_all()
        except Pixel2CatchError as error:
            self.problem = str(error)
        self.is_over = True

    def _play_all(self) -> None:
        with opened_bag(self._path) as reader:
            lead = self._clock.now() - 1e-9 * reader.start_time
            later = self._clock.stamp() - 1e-9 * reader.start_time
            for connection, time, data in reader.messages():
                is_closed = self._is_closed.wait(self._left(1e-9 * time + lead))
                if is_closed:
                    return
                if connection.msgtype in STAMPED:
                    data = _shifted(data, later)
                for inbox in self._listeners.get((connection.topic, connection.msgtype), ()):
                    inbox.put(data)

    def _left(self, moment: float) -> float:
        """Real time until a moment of the clock [s]."""
        return max(0.0, moment - self._clock.now()) / self._clock.rate


@final
class _Silence(Publisher):
    def publish(self, data: bytes) -> None:
        """Do nothing."""


@final
class _Replayed(Subscription):
    def __init__(self, inbox: Inbox, begin: Callable[[], None]) -> None:
        self._inbox, self._begin = inbox, begin

    def take(self) -> list[Packet]:
        self._begin()
        return self._inbox.take()


def _shifted(data: bytes, seconds: float) -> bytes:
    """A message with another stamp in its header, which is the first that is in it."""
    form = "<iI" if data[1] else ">iI"
    sec, nanosec = struct.unpack_from(form, data, 4)
    stamp = sec * 10**9 + nanosec + round(seconds * 1e9)
    changed = bytearray(data)
    struct.pack_into(form, changed, 4, *divmod(stamp, 10**9))
    return bytes(changed)
