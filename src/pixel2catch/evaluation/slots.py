"""Slots, which compute one cell at a time each: in this process, in a worker, or as a job of a cluster."""

import contextlib
import os
import pickle
import shutil
import subprocess
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from pixel2catch.errors import StudyError
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import end_with_parent
from pixel2catch.own_files import import_files

if TYPE_CHECKING:
    from submitit import AutoExecutor

CLUSTER = "slurm"  #: The kind of cluster, by its name in submitit.
GRACE_SECONDS = 120.0  #: Longest time for a stopped cell to save its work [s]. Source: ours, one rollout.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
ONE_THREAD: dict[str, str] = dict.fromkeys(THREADS, "1")  #: Variables that give libraries one thread each.
MPS_CONTROL = "nvidia-cuda-mps-control"
MPS_SECONDS = 20.0  #: Longest time for the MPS daemon to answer [s].

Call = Callable[..., str | None]  #: A function that returns the text of an error or nothing.


class Slot(ABC):
    """A place that computes one cell at a time."""

    is_here = False  #: Whether cells are computed in this process.
    poll_seconds = 0.1  #: Time between two looks at the running cells [s].

    def __init__(self, kind: str, device: str) -> None:
        """Take cells of this kind, for this device."""
        self.kind, self.device = kind, device

    @abstractmethod
    def submit(self, function: Call, *args: Any) -> Any:
        """Call a function; return a task with `done` and `result`."""

    @abstractmethod
    def stop(self) -> None:
        """Ask the running cell to end in order."""

    @abstractmethod
    def close(self) -> None:
        """Wait for the end of a stopped cell, and free what the slot holds."""


@final
class ThisProcess(Slot):
    """Computes cells one after the other in this process."""

    is_here, poll_seconds = True, 0.0

    def submit(self, function: Call, *args: Any) -> Any:
        """Call the function and wait for it."""
        future = Future[str | None]()
        future.set_result(function(*args))
        return future

    def stop(self) -> None:
        """Do nothing: no cell runs between two calls."""

    def close(self) -> None:
        """Do nothing: the slot holds nothing."""


@final
class Worker(Slot):
    """Computes cells in a process and a session of its own: Ctrl-C reaches this process alone."""

    def __init__(
        self, kind: str, device: str, environment: Mapping[str, str] | None = None, *, is_reused: bool = True
    ) -> None:
        """Start no process yet; it gets `environment` too. Without reuse each cell has its own process."""
        super().__init__(kind, device)
        self._environment, self._is_reused, self._is_stopped = environment or {}, is_reused, False
        self._pool: ProcessPoolExecutor | None = None
        self._processes = set[BaseProcess]()
        self._task: Future[str | None] | None = None

    def submit(self, function: Call, *args: Any) -> Any:
        """Call the function in the process; start one if there is none that can be used."""
        if self._task and (self._task.exception() or not self._is_reused):
            self.close()
        self._pool = self._pool or ProcessPoolExecutor(1, get_context("spawn"), _begin)
        before = set(active_children())
        with _environment(self._environment):
            self._task = self._pool.submit(function, *args)
        self._processes |= set(active_children()) - before
        return self._task

    def stop(self) -> None:
        """Terminate the process, which may first save its work."""
        self._is_stopped = True
        for process in self._processes:
            process.terminate()

    def close(self) -> None:
        """End the process; kill it if it takes too long after it was stopped."""
        if self._is_stopped and self._task and wait([self._task], GRACE_SECONDS).not_done:
            for process in self._processes:
                process.kill()
        if self._pool:
            self._pool.shutdown(cancel_futures=True)
        self._pool, self._task, self._processes = None, None, set()


@final
class ClusterJob(Slot):
    """Computes each cell as a job of a cluster."""

    poll_seconds = 1.0

    def __init__(self, kind: str, device: str, executor: "AutoExecutor") -> None:
        """Submit cells to an executor of submitit."""
        super().__init__(kind, device)
        self._executor, self._deadline = executor, 0.0
        self._job: Any = None

    def submit(self, function: Call, *args: Any) -> Any:
        """Submit the call; it is unpickled after files of the user's own are imported."""
        self._job = self._executor.submit(_call, pickle.dumps((function, args)))
        return self._job

    def stop(self) -> None:
        """Cancel the job: the cluster terminates it, and kills it some time later."""
        self._job.cancel(check=False)
        self._deadline = time.monotonic() + GRACE_SECONDS

    def close(self) -> None:
        """Wait for the end of a cancelled job."""
        while time.monotonic() < self._deadline and not self._job.done():
            time.sleep(self.poll_seconds)


def error_of(task: Any) -> str | None:
    """Return the text of the error of a task that has ended, or nothing."""
    try:
        return task.result()
    except BrokenProcessPool:
        return "its process was ended from outside; if memory was short, compute fewer cells at once"
    except Exception as error:  # of submitit: the job's output, whose last line names the error
        lines = [line for line in str(error).splitlines() if line.strip("- ")]
        return next((line for line in reversed(lines) if "Error: " in line), lines[0] if lines else "")


def cluster_executor(asked: tuple[str, ...], folder: Path) -> "AutoExecutor | None":
    """Return the executor for jobs of a cluster, or nothing if nothing is asked of one.

    Args:
        asked: What every job asks for, as NAME=VALUE with names of submitit, such as timeout_min=240.
        folder: Folder of the study, shared by all nodes; submitit's files are in its folder `jobs`.

    Raises:
        StudyError: There is no cluster, submitit is missing, or a name or value is invalid.
    """
    if not asked:
        return None
    with needs_extra("slurm", "--slurm needs submitit", StudyError):
        from submitit import AutoExecutor
    values = {name: value for name, _, value in (each.partition("=") for each in asked)}
    try:
        executor = AutoExecutor(folder.absolute() / "jobs", cluster=CLUSTER)
        executor.update_parameters(
            name=folder.name, **{n: int(v) if v.isdigit() else v for n, v in values.items()}
        )
    except (RuntimeError, NameError, AssertionError, ValueError) as error:
        raise StudyError(f"the cluster refuses such jobs: {error}") from error
    return executor


def _begin() -> None:
    """Prepare a worker process."""
    os.setsid()
    import_files()  # values of the user's own files can then be unpickled
    end_with_parent()


def _call(payload: bytes) -> str | None:
    import_files()
    function, args = pickle.loads(payload)
    return function(*args)


@contextlib.contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for a process that is started within."""
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextlib.contextmanager
def shared_gpus() -> Iterator[dict[str, str]]:
    """Run a daemon of NVIDIA's Multi-Process Service, so that processes compute on a GPU at the same time.

    Yields the environment variables by which workers find the daemon: none without the service, or if the
    environment of this process names a daemon already. Settings of the GPU stay as they are.
    """
    if "CUDA_MPS_PIPE_DIRECTORY" in os.environ or shutil.which(MPS_CONTROL) is None:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="pixel2catch-mps-") as folder:
        variables = {"CUDA_MPS_PIPE_DIRECTORY": folder, "CUDA_MPS_LOG_DIRECTORY": folder}

        def control(arguments: list[str], command: str) -> bool:
            try:
                subprocess.run(
                    [MPS_CONTROL, *arguments],
                    input=command,
                    env=os.environ | variables,
                    capture_output=True,
                    text=True,
                    timeout=MPS_SECONDS,
                    check=True,
                )
            except (OSError, subprocess.SubprocessError):
                return False
            return True

        is_running = control(["-d"], "")
        try:
            yield variables if is_running else {}
        finally:
            if is_running:
                control([], "quit\n")
