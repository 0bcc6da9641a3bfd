"""Recording of a deployment as a rosbag2 (MCAP), for `identify`, `track`, `replay` and the tools of ROS 2."""

import atexit
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from queue import SimpleQueue
from threading import Lock, Thread
from typing import Literal, final

import numpy as np
from rosbags.interfaces import Connection as BagConnection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from pixel2catch.errors import DeploymentError
from pixel2catch.interruption import on_signals
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import STORE, compress, compressed_topic
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, Message, Topic, Transport
from pixel2catch.servo.link import RECORDER_PRIORITY, give_way

MOST_WAITING = 128 * 2**20  #: Messages that wait to be written [bytes]: 4 s of images. Source: ours.

Convert = Callable[[bytes], bytes]  #: Makes the message to write from the recorded one, such as a JPEG.


@final
class BagRecorder(AbstractContextManager["BagRecorder"]):
    """Writes messages in its own thread. Use it as a context manager, which completes the file.

    A slow or full disk never delays the caller: messages that cannot be written are dropped and counted.
    After a kill the file lacks the last moments only, and `mcap recover` makes it readable.
    """

    def __init__(self, folder: Path) -> None:
        """Start a recording in a new folder; raise DeploymentError if it exists or cannot be made."""
        self.num_written: Counter[str] = Counter()  #: Messages written, by topic.
        self.num_dropped: Counter[str] = Counter()  #: Messages lost, by topic.
        self.problem = ""  #: Why nothing can be written; empty if messages can.
        self.unconverted = ""  #: Why the last message that could not be converted was dropped; empty if none.
        self._connections: dict[Topic, BagConnection] = {}
        self._waiting, self._lock, self._is_hurried = 0, Lock(), False
        self._queue: SimpleQueue[tuple[Topic, bytes, int, Convert] | None] = SimpleQueue()
        try:
            self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        except (OSError, WriterError) as error:
            raise DeploymentError(f"{folder}: no recording ({error}); choose another name.") from error
        self._thread = Thread(target=self._write_all, name="recorder", daemon=True)
        self._thread.start()
        atexit.register(self.__exit__)  # a second signal may come where no context ends

    def record(self, topic: Topic, data: bytes, stamp: float, convert: Convert = bytes) -> None:
        """Record a message of a time of day [s], from any thread; it is converted in the recorder's."""
        with self._lock:
            if self.problem or self._waiting + len(data) > MOST_WAITING:
                self.num_dropped[topic.name] += 1
                return
            self._waiting += len(data)
        self._queue.put((topic, data, round(stamp * 1e9), convert))

    def __exit__(self, *exception: object) -> None:
        """Write the waiting messages, and complete the file; a signal drops those that still wait."""
        with on_signals(self._hurry):
            self._queue.put(None)
            self._thread.join()
            try:
                self._writer.close()
            except OSError as error:
                self.problem = self.problem or str(error)
                with suppress(OSError):
                    self._writer.abort()
            atexit.unregister(self.__exit__)

    def _hurry(self, *_: object) -> None:
        self._is_hurried, self.unconverted = True, "the program was told to end at once"

    def _write_all(self) -> None:
        give_way(RECORDER_PRIORITY)
        while entry := self._queue.get():
            topic, data, stamp, convert = entry
            is_written = not (self.problem or self._is_hurried) and self._write(topic, data, stamp, convert)
            with self._lock:
                self._waiting -= len(data)
                (self.num_written if is_written else self.num_dropped)[topic.name] += 1

    def _write(self, topic: Topic, data: bytes, stamp: int, convert: Convert) -> bool:
        """Return whether a message was written; whatever goes wrong, the deployment continues."""
        try:
            converted = convert(data)
        except Exception as error:  # only this message is lost
            self.unconverted = f"{type(error).__name__}: {error}"
            return False
        try:
            if topic not in self._connections:
                added = self._writer.add_connection(topic.name, topic.type, typestore=STORE)
                self._connections[topic] = added
            self._writer.write(self._connections[topic], stamp, converted)
        except Exception as error:  # nothing can be written any further
            self.problem = f"{type(error).__name__}: {error}"
            return False
        return True


SERVO = Topic(name="/pixel2catch/servo", type=messages.FLOAT_ARRAY)  #: `Command.row` of every tick.
TARGETS = Topic(name="/pixel2catch/policy_command", type=messages.FLOAT_ARRAY)  #: `JointTargets.row`.
DEPTH = 512  #: Messages kept between two control steps.
LONGEST = 0.5  #: Time between two polls after which messages may be lost [s]. Source: ours, half of `DEPTH`.
HELD_UP = "the recording may lack messages, because this program was delayed: end others, and record again."
RESOLUTION = 1e-6  #: Least time between two messages of a topic [s]; readers of bags sort by time.
ImageStorage = Literal["jpeg", "raw", "none"]  #: How images are recorded; raw ones take 27 MB/s.


class DeploymentRecorder:
    """Records a deployment: the messages on the network, and rows of servo and policy."""

    def __init__(
        self,
        recorder: BagRecorder,
        transport: Transport,
        profile: Profile,
        clock: Clock,
        images: ImageStorage,
    ) -> None:
        """Subscribe to joint states, commands, robot status and operator, without ending any wait."""
        self._recorder, self._clock, self._profile, self._images = recorder, clock, profile, images
        self._last: dict[Topic, float] = {}
        self._polled, self._has_gaps = np.inf, False
        commands, operator = {part.command_topic for part in profile.robots}, vars(profile.operator).values()
        topics = profile.driver_topics | commands | {*operator}
        self._subscriptions = {
            topic: transport.subscription(topic, DEPTH, only_watches=True) for topic in topics
        }

    @property
    def trouble(self) -> str:
        """Why the recording lacks messages; empty if it is complete."""
        recorder, num_lost = self._recorder, sum(self._recorder.num_dropped.values())
        reason = recorder.problem or recorder.unconverted or "the disk is too slow"
        if num_lost or recorder.problem:
            return f"the recording lacks {num_lost} messages ({reason}): free the disk, and record again."
        return HELD_UP if self._has_gaps else ""

    def require_whole(self) -> None:
        """Raise DeploymentError if the recording has ended and lacks messages."""
        if self.trouble:
            raise DeploymentError(self.trouble)

    def record_messages(self) -> None:
        """Record what has arrived since the last call; call it every `LONGEST` or sooner."""
        now = self._clock.now()
        self._has_gaps |= now - self._polled > LONGEST
        self._polled = now
        for topic, subscription in self._subscriptions.items():
            for message in subscription.take():
                self._write(topic, message.data, message.arrival)

    def record_images(self, received: list[Message]) -> None:
        topic = self._profile.camera.image
        for message in received:
            if self._images == "jpeg":
                self._write(compressed_topic(topic), message.data, message.arrival, compress)
            elif self._images == "raw":
                self._write(topic, message.data, message.arrival)

    def record_row(self, topic: Topic, row: np.ndarray, time: float) -> None:
        """Record numbers of a time, `Clock.now` [s]."""
        self._write(topic, messages.float_array(row), time)

    def _write(self, topic: Topic, data: bytes, time: float, convert: Convert = bytes) -> None:
        stamp = self._clock.stamp() - (self._clock.now() - time)
        self._last[topic] = max(stamp, self._last.get(topic, stamp) + RESOLUTION)  # keeps their order
        self._recorder.record(topic, data, self._last[topic], convert)
