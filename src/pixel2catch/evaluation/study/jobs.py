"""Running commands side by side: parts that depend on each other, and lanes that run one part at a time."""

import contextlib
import fcntl
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from pixel2catch.errors import StudyError

POLL_SECONDS = 0.2
"""Time between two looks at the running parts [s]."""

GRACE_SECONDS = 120.0
"""Time that a part gets to end in order when it is asked to [s]. Source: ours, a rollout and a checkpoint."""


class Status(Enum):
    """How far a part is."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"


@dataclass(frozen=True, kw_only=True)
class Part:
    """A command that has to be run once.

    Attributes:
        name: Name of the part and of its log.
        kind: Which lanes run it.
        command: Program and arguments for the device of a lane, asked for when the part starts.
        is_done: Whether its result is there.
        after: Names of earlier parts that must be done before.
    """

    name: str
    kind: str
    command: Callable[[str], Sequence[str]]
    is_done: Callable[[], bool]
    after: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Lane:
    """A place that runs one part at a time.

    Attributes:
        kind: What it runs.
        device: What it computes on.
        environment: Environment variables that its parts get beside those of this process.
    """

    kind: str
    device: str
    environment: Mapping[str, str] = field(default_factory=dict)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[int]:
    """Hold a folder for this process and the parts that it starts; yields the lock's file descriptor.

    Raises:
        StudyError: If somebody else holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".lock", "wb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StudyError(
                f"'{folder}' is in use by another 'pixel2catch reproduce' or by a training or an evaluation "
                "that one left behind; wait for it or end it, then start again."
            ) from error
        yield file.fileno()


class Runner:
    """Runs parts in lanes, the first ready one first. One that fails holds up only what comes after it.

    Attributes:
        status: How far every part is, by name.
    """

    def __init__(
        self, parts: Sequence[Part], lanes: Sequence[Lane], logs: Path, lock: int | None = None
    ) -> None:
        """See what is done already; a part is not done as long as one before it is not.

        Args:
            parts: The parts, each behind those that it depends on.
            lanes: Where they run.
            logs: Folder of their outputs, `NAME.log`.
            lock: What `locked` gave; parts hold it too, in case that they outlive this process.
        """
        self.status: dict[str, Status] = {}
        for part in parts:
            is_done = self._is_ready(part) and part.is_done()
            self.status[part.name] = Status.DONE if is_done else Status.WAITING
        self._parts, self._lanes, self._logs = parts, lanes, logs
        self._inherited = () if lock is None else (lock,)
        self._running: dict[int, tuple[Part, subprocess.Popen[bytes]]] = {}

    def run(
        self,
        watch: Callable[[Mapping[str, Status]], None] = lambda _: None,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Run until nothing is left that can be run.

        Args:
            watch: Called at every look with the status of all parts.
            is_stopped: Whether to end early: running parts are terminated, in order if they know how.
        """
        self._logs.mkdir(parents=True, exist_ok=True)
        try:
            while not is_stopped():
                self._start_parts()
                watch(self.status)
                if not self._running:
                    return
                time.sleep(POLL_SECONDS)
                self._end_parts()
        finally:
            self._stop_parts()
            watch(self.status)

    def log(self, name: str) -> Path:
        """Output of a part."""
        return self._logs / f"{name}.log"

    def _is_ready(self, part: Part) -> bool:
        return all(self.status[name] is Status.DONE for name in part.after)

    def _start_parts(self) -> None:
        for i, lane in enumerate(self._lanes):
            ready = (p for p in self._parts if self.status[p.name] is Status.WAITING and self._is_ready(p))
            part = next((p for p in ready if p.kind == lane.kind), None)
            if part is not None and i not in self._running:
                self._running[i] = part, self._start(part, lane)
                self.status[part.name] = Status.RUNNING

    def _start(self, part: Part, lane: Lane) -> subprocess.Popen[bytes]:
        """Start a part in a session of its own, so that Ctrl-C reaches it only through this runner."""
        with open(self.log(part.name), "ab") as log:
            return subprocess.Popen(
                list(part.command(lane.device)),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | lane.environment,
                pass_fds=self._inherited,
                start_new_session=True,
            )

    def _end_parts(self) -> None:
        for i, (part, process) in list(self._running.items()):
            if process.poll() is not None:
                is_done = process.returncode == 0 and part.is_done()
                self.status[part.name] = Status.DONE if is_done else Status.FAILED
                del self._running[i]

    def _stop_parts(self) -> None:
        """Ask what still runs to end, and kill what does not; what has just been done counts."""
        processes = [process for _, process in self._running.values()]
        for process in processes:
            process.terminate()
        deadline = time.monotonic() + GRACE_SECONDS
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):
                for process in processes:
                    process.wait(max(0.0, deadline - time.monotonic()))
        finally:
            for process in processes:
                process.kill()
                process.wait()
        for part, _ in self._running.values():
            self.status[part.name] = Status.DONE if part.is_done() else Status.STOPPED
        self._running.clear()


def last_lines(path: Path, number: int = 15) -> str:
    """The end of a log, nothing where there is none."""
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    return "\n".join(text.rstrip().splitlines()[-number:])
