"""What a deployment saw and did, as a rosbag2 (MCAP) for `identify`, `track` and ROS's tools."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Lock, Thread
from typing import Literal, NamedTuple, final

import numpy as np
from rosbags.interfaces import Connection as BagConnection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import STORE, compress, compressed_topic
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Message, Topic, Transport
from pixel2catch.servo.link import RECORDER_PRIORITY, Command, LoopEnd, give_way

MOST_WAITING = 128 * 2**20  #: Messages that wait to be written [bytes]: 4 s of images. Source: ours.


Convert = Callable[[bytes], bytes]  #: Makes what is written of what was recorded, such as a smaller image.


class _Entry(NamedTuple):
    topic: Topic
    data: bytes
    stamp: int
    convert: Convert


@final
class BagRecorder(AbstractContextManager["BagRecorder"]):
    """Writes messages in a thread of its own; use it as a context manager, which ends the file properly.

    A slow or full disk never holds up the caller: what cannot be written is dropped and counted. After a kill
    the file has all but the last moments, and `mcap recover` makes it readable.
    """

    def __init__(self, folder: Path) -> None:
        """Begin a recording, a new folder.

        Raises:
            DeploymentError: It exists, or cannot be made.
        """
        self.num_written: Counter[str] = Counter()  #: Messages written, by topic.
        self.num_dropped: Counter[str] = Counter()  #: Messages lost, by topic.
        self.problem = ""  #: What keeps messages from being written; empty if nothing does.
        self._connections: dict[Topic, BagConnection] = {}
        self._waiting, self._lock = 0, Lock()
        self._queue: SimpleQueue[_Entry | None] = SimpleQueue()
        try:
            self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        except (OSError, WriterError) as error:
            raise DeploymentError(
                f"{folder}: no recording can be made ({error}); choose another name."
            ) from error
        self._thread = Thread(target=self._write_all, name="recorder", daemon=True)
        self._thread.start()

    def record(self, topic: Topic, data: bytes, stamp: float, convert: Convert = bytes) -> None:
        """Keep a message of this time, `Clock.stamp` [s]; any thread may call this.

        It is converted in the recorder's thread; if that is refused, it is dropped.
        """
        with self._lock:
            if self.problem or self._waiting + len(data) > MOST_WAITING:
                self.num_dropped[topic.name] += 1
                return
            self._waiting += len(data)
        self._queue.put(_Entry(topic, data, round(stamp * 1e9), convert))

    def close(self) -> None:
        """Write what waits, and end the file."""
        if not self._thread.is_alive():
            return
        self._queue.put(None)
        self._thread.join()
        try:
            self._writer.close()
        except OSError as error:
            self.problem = self.problem or str(error)
            with suppress(OSError):
                self._writer.abort()

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def _write_all(self) -> None:
        give_way(RECORDER_PRIORITY)
        while entry := self._queue.get():
            is_written = not self.problem and self._write(entry)
            with self._lock:
                self._waiting -= len(entry.data)
                (self.num_written if is_written else self.num_dropped)[entry.topic.name] += 1

    def _write(self, entry: _Entry) -> bool:
        """Write a message; whether that went well."""
        topic = entry.topic
        try:
            data = entry.convert(entry.data)
        except DeploymentError:
            return False
        try:
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic.name, topic.type, typestore=STORE
                )
            self._writer.write(self._connections[topic], entry.stamp, data)
        except Exception as error:  # whatever it is, the robot goes on
            self.problem = f"{type(error).__name__}: {error}"
            return False
        return True


SERVO = Topic(name="/pixel2catch/servo", type=messages.FLOAT_ARRAY)  #: Ticks of the servo, `Command.row`.
ORDERS = Topic(
    name="/pixel2catch/policy_command", type=messages.FLOAT_ARRAY
)  #: Its orders, `JointTargets.row`.
DEPTH = 512  #: Messages that are kept between two control steps.
LONGEST = 0.5  #: Time between two looks after which messages may be lost [s]. Source: ours, half of `DEPTH`.
HELD_UP = "the recording may lack messages, as this program was held up: end others, and record anew."
RESOLUTION = 1e-6  #: Least time between two messages of a topic [s]: readers of bags sort by it.
Images = Literal["jpeg", "raw", "none"]  #: How images are recorded; raw ones are 27 MB a second.


class DeploymentRecorder:
    """Records a deployment; what is sent over the network is recorded as everybody else hears it."""

    def __init__(
        self, recorder: BagRecorder, transport: Transport, profile: Profile, clock: Clock, images: Images
    ) -> None:
        """Begin to listen to joint states, commands and operator; the loop does not wake for any of them."""
        self._recorder, self._clock = recorder, clock
        self._profile, self._images = profile, images
        self._last: dict[Topic, float] = {}
        self._looked, self._has_gaps = np.inf, False
        topics = profile.told | {part.command_topic for part in profile.robots}
        topics |= {*vars(profile.operator).values()}
        self._subscriptions = [
            (topic, transport.subscription(topic, DEPTH, only_watches=True)) for topic in topics
        ]

    @property
    def trouble(self) -> str:
        """What keeps the recording from being whole, in words; empty if nothing does."""
        recorder, num_lost = self._recorder, sum(self._recorder.num_dropped.values())
        if not (num_lost or recorder.problem):
            return HELD_UP if self._has_gaps else ""
        reason = recorder.problem or "the disk is too slow, or a message is damaged"
        return (
            f"the recording lacks {num_lost} messages ({reason}): free or change the disk, and record anew."
        )

    def require_whole(self) -> None:
        """Complain of a recording that has ended and is not whole.

        Raises:
            DeploymentError: Messages are missing.
        """
        if self.trouble:
            raise DeploymentError(self.trouble)

    def record_messages(self) -> None:
        """Record what has arrived since the last call, which must not be longer ago than `LONGEST`."""
        now = self._clock.now()
        self._has_gaps |= now - self._looked > LONGEST
        self._looked = now
        for topic, subscription in self._subscriptions:
            for message in subscription.take():
                self._write(topic, message.data, message.arrival)

    def record_images(self, received: list[Message]) -> None:
        """Record images."""
        topic = self._profile.camera.image
        for message in received:
            if self._images == "jpeg":
                self._write(compressed_topic(topic), message.data, message.arrival, compress)
            elif self._images == "raw":
                self._write(topic, message.data, message.arrival)

    def record_row(self, topic: Topic, row: np.ndarray, time: float) -> None:
        """Record numbers of this time, `Clock.now` [s]."""
        self._write(topic, messages.float_array(row), time)

    def _write(self, topic: Topic, data: bytes, time: float, convert: Convert = bytes) -> None:
        """Record a message of a moment of `Clock.now` [s]; those of one moment keep their order."""
        stamp = self._clock.stamp() - (self._clock.now() - time)
        self._last[topic] = max(stamp, self._last.get(topic, stamp) + RESOLUTION)
        self._recorder.record(topic, data, self._last[topic], convert)


@dataclass(frozen=True, kw_only=True)
class Connection:
    """Network, servo, clock and recording."""

    transport: Transport  #: The node of the network.
    servo: LoopEnd  #: The control loop's end of the link to the servo process.
    servo_dt: float  #: Time between two ticks of the servo [s].
    clock: Clock
    recording: DeploymentRecorder | None

    def hear(self) -> Iterator[Command]:
        """Yield what the servo has said since the last call, and record it.

        Raises:
            DeploymentError: The servo process is gone.
        """
        for command in self.servo.receive():
            if self.recording:
                self.recording.record_row(SERVO, command.row, command.time)
            yield command
        if self.servo.is_closed:
            raise DeploymentError(
                "the servo process has ended, and nothing guards the robot: press its stop. What the process "
                "said of the reason is above."
            )
