"""Running commands side by side: jobs that depend on each other, and slots that run one job at a time.

Several processes can work on one GPU at the same time with NVIDIA's Multi-Process Service (MPS). Without it
their kernels take turns, and nothing is gained: control steps a second of the environment on one H200 at
120 Hz: one process with 8,192 environments 369 k, two in turns 343 k, two with MPS 464 k.
"""

import contextlib
import fcntl
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING

from pixel2catch.errors import StudyError
from pixel2catch.evaluation.cluster import LOOK_SECONDS, SubmittedCommand

if TYPE_CHECKING:
    from submitit import AutoExecutor

POLL_SECONDS = 0.2  #: Time between two looks at the running jobs [s].
GRACE_SECONDS = 120.0  #: Time of a job to end when asked to [s]. Source: ours, a rollout and a checkpoint.

MPS_CONTROL = "nvidia-cuda-mps-control"
MPS_START_SECONDS = 20.0


class Status(Enum):
    """How far a job is."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"


@dataclass(frozen=True, kw_only=True)
class Job:
    """A command that has to be run once."""

    name: str  #: Name of the job and of its log.
    kind: str  #: Which slots run it.
    #: Program and arguments for the device of a slot, asked for when the job starts.
    command: Callable[[str], Sequence[str]]
    is_done: Callable[[], bool]  #: Whether its result is there.
    after: tuple[str, ...] = ()  #: Names of earlier jobs that must be done before.


@dataclass(frozen=True, kw_only=True)
class Slot:
    """A place that runs one job at a time."""

    kind: str  #: What it runs.
    device: str  #: What it computes on.
    #: Environment variables that its jobs get beside those of this process.
    environment: Mapping[str, str] = field(default_factory=dict)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[int]:
    """Hold a folder for this process and the jobs that it starts; yields the lock's file descriptor.

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
    """Runs jobs in slots, the first ready one first. One that fails holds up only what comes after it."""

    def __init__(
        self,
        jobs: Sequence[Job],
        slots: Sequence[Slot],
        logs: Path,
        lock: int | None = None,
        executor: "AutoExecutor | None" = None,
    ) -> None:
        """See what is done already; a job is not done as long as one before it is not.

        The jobs come behind those that they depend on, and print to `NAME.log` in the folder of the logs.
        They hold the lock that `locked` gave, too, in case that they outlive this process. With an executor
        they are jobs of its cluster.
        """
        self.status: dict[str, Status] = {}  #: How far every job is, by name.
        for job in jobs:
            is_done = self._is_ready(job) and job.is_done()
            self.status[job.name] = Status.DONE if is_done else Status.WAITING
        self._jobs, self._slots, self._logs = jobs, slots, logs
        self._inherited = () if lock is None else (lock,)
        self._executor = executor
        self._running: dict[int, tuple[Job, subprocess.Popen[bytes] | SubmittedCommand]] = {}

    def run(
        self,
        watch: Callable[[Mapping[str, Status]], None] = lambda _: None,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Run until nothing is left that can be run, and watch the status of all jobs at every look.

        When it is stopped early, running jobs are terminated, in order if they know how.
        """
        self._logs.mkdir(parents=True, exist_ok=True)
        try:
            while not is_stopped():
                self._start_jobs()
                watch(self.status)
                if not self._running:
                    return
                time.sleep(LOOK_SECONDS if self._executor else POLL_SECONDS)
                self._end_jobs()
        finally:
            self._stop_jobs()
            watch(self.status)

    def log(self, name: str) -> Path:
        """Output of a job."""
        return self._logs / f"{name}.log"

    def _is_ready(self, job: Job) -> bool:
        return all(self.status[name] is Status.DONE for name in job.after)

    def _start_jobs(self) -> None:
        for i, slot in enumerate(self._slots):
            waiting = (each for each in self._jobs if self.status[each.name] is Status.WAITING)
            ready = (each for each in waiting if each.kind == slot.kind and self._is_ready(each))
            job = next(ready, None)
            if job is not None and i not in self._running:
                self._running[i] = job, self._start(job, slot)
                self.status[job.name] = Status.RUNNING

    def _start(self, job: Job, slot: Slot) -> "subprocess.Popen[bytes] | SubmittedCommand":
        """Start a job in a session of its own, so that Ctrl-C reaches it only through this runner."""
        command = list(job.command(slot.device))
        if self._executor:
            return SubmittedCommand(self._executor, command, self.log(job.name), slot.environment)
        with open(self.log(job.name), "ab") as log:
            return subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | slot.environment,
                pass_fds=self._inherited,
                start_new_session=True,
            )

    def _end_jobs(self) -> None:
        for i, (job, process) in list(self._running.items()):
            if process.poll() is not None:
                is_done = process.returncode == 0 and job.is_done()
                self.status[job.name] = Status.DONE if is_done else Status.FAILED
                del self._running[i]

    def _stop_jobs(self) -> None:
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
        for job, _ in self._running.values():
            self.status[job.name] = Status.DONE if job.is_done() else Status.STOPPED
        self._running.clear()


def last_lines(path: Path, number: int = 15) -> str:
    """The end of a log, nothing where there is none."""
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    return "\n".join(text.rstrip().splitlines()[-number:])


@contextlib.contextmanager
def shared_gpus() -> Iterator[dict[str, str]]:
    """Run an MPS daemon of our own, which ends with the context; the GPU's settings stay as they are.

    It yields the environment variables with which child processes find it; none where MPS is not to be had,
    or where the caller's environment names a daemon already.
    """
    if "CUDA_MPS_PIPE_DIRECTORY" in os.environ or shutil.which(MPS_CONTROL) is None:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="pixel2catch-mps-") as folder:
        variables = {"CUDA_MPS_PIPE_DIRECTORY": folder, "CUDA_MPS_LOG_DIRECTORY": folder}
        is_running = _call_mps(["-d"], "", variables)
        try:
            yield variables if is_running else {}
        finally:
            if is_running:
                _call_mps([], "quit\n", variables)


def _call_mps(arguments: list[str], command: str, variables: dict[str, str]) -> bool:
    """Call the daemon's control program; whether it said yes."""
    try:
        subprocess.run(
            [MPS_CONTROL, *arguments],
            input=command,
            env=os.environ | variables,
            capture_output=True,
            text=True,
            timeout=MPS_START_SECONDS,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return False
    return True
