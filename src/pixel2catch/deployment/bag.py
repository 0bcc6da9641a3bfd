"""A recording as a network: its messages come again as they came. Needs rosbags."""

import struct
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import final

from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.compressed import COMPRESSED_IMAGE, SUFFIX, uncompress
from pixel2catch.deployment.inbox import Inbox, Inboxes
from pixel2catch.deployment.messages import CAMERA_INFO, IMAGE, JOINT_STATE
from pixel2catch.deployment.transport import Packet, Publisher, Subscription, Topic, Transport
from pixel2catch.errors import DeploymentError, PerceptionError
from pixel2catch.perception.rosbag_images import opened_bag

STAMPED = (CAMERA_INFO, IMAGE, JOINT_STATE)
"""Types that begin with a header."""


@final
class ReplayTransport(Transport):
    """Plays a rosbag2 in its own time, from the first look on; what is published goes nowhere.

    Headers get the stamps that they would have if all happened now. JPEG images come as the raw ones that
    they were.

    Attributes:
        start: Time of the first message, since the epoch [s].
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        """Open a recording.

        Args:
            path: The bag's folder, or its .mcap or .db3 file.
            clock: Its time.

        Raises:
            PerceptionError: It cannot be read.
        """
        self._clock, self._inboxes = clock, Inboxes(clock)
        self._listeners: dict[tuple[str, str], list[Inbox]] = {}
        self._bag = ExitStack()
        reader = self._bag.enter_context(opened_bag(path))
        self.start = 1e-9 * reader.start_time
        self._messages = reader.messages()
        self._begin, self._later = inf, 0.0
        self._next = self._read()

    @property
    def is_over(self) -> bool:
        """Whether all messages have come."""
        return self._next is None

    def publisher(self, topic: Topic) -> Publisher:
        """Announce a topic; nobody hears it."""
        del topic
        return _Silence()

    def subscription(self, topic: Topic, depth: int = 1) -> Subscription:
        """Begin to listen to a recorded topic."""
        inbox = self._inboxes.add(depth)
        self._listeners.setdefault((topic.name, topic.type), []).append(inbox)
        return _Replayed(inbox, self._play)

    def num_other_publishers(self, topic: Topic) -> int:
        """None: the recorded commands are not sent."""
        del topic
        return 0

    def wait(self, seconds: float) -> bool:
        """Wait until a message can be taken, or for a time [s]; say which."""
        end = self._clock.now() + seconds
        self._play()
        while not (has_come := self._inboxes.wait(0.0)) and self._clock.now() < end:
            self._clock.sleep_until(min(end, self._due))
            self._play()
        return has_come

    def close(self) -> None:
        """Close the recording."""
        self._bag.close()

    @property
    def _due(self) -> float:
        """When the next message comes, `Clock.now` [s]."""
        return inf if self._next is None else self._begin + self._next.time - self.start

    def _play(self) -> None:
        """Let come what is due."""
        now = self._clock.now()
        if self._begin == inf:
            self._begin, self._later = now, self._clock.stamp() - self.start
        while self._next is not None and self._due <= now:
            with suppress(DeploymentError):  # one that is damaged is as lost as on a network
                self._deliver(self._next)
            self._next = self._read()

    def _deliver(self, recorded: "_Recorded") -> None:
        """Bring a message to all that listen."""
        name, kind, data = recorded.name, recorded.type, recorded.data
        if kind == COMPRESSED_IMAGE:
            name, kind = name.removesuffix(SUFFIX), IMAGE
        inboxes = self._listeners.get((name, kind), ())
        if not inboxes:
            return
        if recorded.type == COMPRESSED_IMAGE:
            data = uncompress(data)
        if kind in STAMPED:
            data = _shifted(data, self._later)
        for inbox in inboxes:
            inbox.put(data)

    def _read(self) -> "_Recorded | None":
        """The next message of the recording."""
        try:
            message = next(self._messages, None)
        except Exception as error:  # a damaged bag makes the library raise whatever it likes
            raise PerceptionError(f"the recording cannot be read further ({error}).") from error
        if message is None:
            return None
        connection, time, data = message
        return _Recorded(name=connection.topic, type=connection.msgtype, time=1e-9 * time, data=bytes(data))


@dataclass(frozen=True, kw_only=True)
class _Recorded:
    """A message of a recording, which came at a time since the epoch [s]."""

    name: str
    type: str
    time: float
    data: bytes


@final
class _Silence(Publisher):
    def publish(self, data: bytes) -> None:
        """Do nothing."""


@final
class _Replayed(Subscription):
    def __init__(self, inbox: Inbox, play: Callable[[], None]) -> None:
        self._inbox, self._play = inbox, play

    def take(self) -> list[Packet]:
        self._play()
        return self._inbox.take()


def _shifted(data: bytes, seconds: float) -> bytes:
    """A message with another stamp in its header, which is the first that is in it."""
    form = "<iI" if data[1] else ">iI"
    sec, nanosec = struct.unpack_from(form, data, 4)
    stamp = sec * 10**9 + nanosec + round(seconds * 1e9)
    changed = bytearray(data)
    struct.pack_into(form, changed, 4, *divmod(stamp, 10**9))
    return bytes(changed)
