"""What a deployment saw and did, as a rosbag2 (MCAP) for `identify`, `track` and ROS's tools."""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from threading import Lock, Thread
from typing import NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from pixel2catch.deployment.cdr import STORE
from pixel2catch.deployment.transport import Topic
from pixel2catch.errors import DeploymentError

MOST_WAITING = 128 * 2**20
"""Messages that wait to be written [bytes]: 4 s of images. Source: ours."""


Convert = Callable[[bytes], bytes]
"""Makes what is written of what was recorded, such as a smaller image."""


class _Entry(NamedTuple):
    topic: Topic
    data: bytes
    stamp: int
    convert: Convert


class Recorder:
    """Writes messages in a thread of its own; use it as a context manager, which ends the file properly.

    A slow or full disk never holds up the caller: what cannot be written is dropped and counted. After a kill
    the file has all but the last moments, and `mcap recover` makes it readable.

    Attributes:
        num_written: Messages written, by topic.
        num_dropped: Messages lost, by topic.
        problem: What keeps messages from being written; empty if nothing does.
    """

    def __init__(self, folder: Path) -> None:
        """Begin a recording.

        Args:
            folder: The rosbag2, a folder that does not exist.

        Raises:
            DeploymentError: It exists, or cannot be made.
        """
        self.num_written: Counter[str] = Counter()
        self.num_dropped: Counter[str] = Counter()
        self.problem = ""
        self._connections: dict[Topic, Connection] = {}
        self._waiting, self._lock = 0, Lock()
        self._queue: SimpleQueue[_Entry | None] = SimpleQueue()
        self._writer = _open(folder)
        self._thread = Thread(target=self._write_all, name="recorder", daemon=True)
        self._thread.start()

    def record(self, topic: Topic, data: bytes, stamp: float, convert: Convert = bytes) -> None:
        """Keep a message; any thread may call this.

        Args:
            topic: What it is written as.
            data: Its CDR.
            stamp: When it was sent or received, `Clock.stamp` [s].
            convert: Called in the recorder's thread; a message that it refuses is dropped.
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

    def __enter__(self) -> "Recorder":
        """Return the recorder itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def _write_all(self) -> None:
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


def _open(folder: Path) -> Writer:
    try:
        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.open()
    except (OSError, WriterError) as error:
        raise DeploymentError(
            f"{folder}: no recording can be made ({error}); choose another name."
        ) from error
    return writer
