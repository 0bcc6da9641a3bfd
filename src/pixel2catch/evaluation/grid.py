"""The cells of a study, and the one loop that computes those that are missing, in workers or on a cluster.

A cell is a call that writes a file. A cell whose file is there is not computed again, so an interrupted study
goes on with the same command. A cell that fails holds up only the cells that need its result.
"""

import contextlib
import os
import pickle
import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from enum import Enum
from multiprocessing import active_children, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from pixel2catch.errors import StudyError
from pixel2catch.files import held, read_json_object
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest, Terminated, end_with_parent, without_interrupts
from pixel2catch.own_files import import_files, in_words

if TYPE_CHECKING:
    from submitit import AutoExecutor

CLUSTER = "slurm"  #: The kind of cluster, by its name in submitit.
GRACE_SECONDS = 120.0  #: Longest time for a stopped cell to save its work [s]. Source: ours, one rollout.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
ONE_THREAD: dict[str, str] = dict.fromkeys(THREADS, "1")  #: Variables that give libraries one thread each.

Json = dict[str, Any]
Work = Callable[[str], None]
Call = Callable[..., str | None]  #: A function for another process; it returns the text of an error, or None.


class Slot(ABC):
    """A place that computes one cell at a time."""

    poll_seconds = 0.1  #: Time between two looks at the running cells [s].

    def __init__(self, kind: str, device: str) -> None:
        self.kind, self.device = kind, device

    @abstractmethod
    def submit(self, function: Call, *args: Any) -> Any:
        """Call a function; return a task with `done` and `result`."""

    @abstractmethod
    def stop(self) -> None:
        """Ask the running cell to end in order."""

    @abstractmethod
    def close(self) -> None:
        """Wait until a stopped cell ends, and free the resources of the slot."""


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
        with _environment(self._environment), without_interrupts():
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


def cluster_executor(asked: Sequence[str], folder: Path) -> "AutoExecutor":
    """Return the executor for jobs of a cluster; raise StudyError if there is none, or it refuses them.

    Every job asks for NAME=VALUE with names of submitit. Its files are in `folder/jobs`, which nodes share.
    """
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


class Status(Enum):
    """State of a cell."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"


@dataclass(frozen=True, kw_only=True)
class StudyCell:
    """One result of a study."""

    name: str  #: Name in messages, and of the log.
    #: Computes the result on a device and writes it. It can be pickled: a partial of a module's function.
    work: Work
    is_done: Callable[[], bool]  #: Returns whether the result is there.
    kind: str = ""  #: Which slots compute it.
    after: tuple[str, ...] = ()  #: Names of earlier cells whose results it needs.


class StudyGrid:
    """The cells of a study with their states."""

    def __init__(self, cells: Sequence[StudyCell]) -> None:
        """Find what is done. A cell after a missing one counts as missing; list it behind that one."""
        self.status: dict[str, Status] = {}  #: State of each cell, by name.
        self.errors: dict[str, str] = {}  #: Errors of the failed cells, by name.
        for cell in cells:
            is_done = self._is_ready(cell) and cell.is_done()
            self.status[cell.name] = Status.DONE if is_done else Status.WAITING
        self._cells = cells
        self._running: dict[int, tuple[StudyCell, Any]] = {}  #: Cell and task, by number of the slot.

    @property
    def missing(self) -> list[StudyCell]:
        return [cell for cell in self._cells if self.status[cell.name] is not Status.DONE]

    def run(
        self, slots: Sequence[Slot], watch: Callable[[], None] = lambda: None, logs: Path | None = None
    ) -> None:
        """Compute the missing cells, until no more can be computed, or the user stops it.

        The first free slot of a kind takes the first ready cell. `watch` is called after every look at the
        running cells. `logs` gets a file `NAME.log` of what each cell prints.
        """
        with StopRequest() as stop:
            try:
                while not stop.is_set:
                    self._start_cells(slots, logs)
                    watch()
                    if not self._running:
                        break
                    time.sleep(min(slot.poll_seconds for slot in slots))
                    self._end_cells()
            finally:
                self._stop_cells(slots)
                watch()
        if stop.is_set and self.missing:
            raise KeyboardInterrupt if stop.by == "SIGINT" else Terminated

    def require_whole(self) -> None:
        """Raise StudyError with a list of the cells that failed, if any did."""
        if self.errors:
            lines = [f"{name} failed: {error}" for name, error in self.errors.items()]
            raise StudyError("\n".join([*lines, "All other cells were computed; run the command again."]))

    def _is_ready(self, cell: StudyCell) -> bool:
        return all(self.status[name] is Status.DONE for name in cell.after)

    def _start_cells(self, slots: Sequence[Slot], logs: Path | None) -> None:
        for number, slot in enumerate(slots):
            waiting = (each for each in self._cells if self.status[each.name] is Status.WAITING)
            ready = (each for each in waiting if each.kind == slot.kind and self._is_ready(each))
            cell = None if number in self._running else next(ready, None)
            if cell is not None:
                self.status[cell.name] = Status.RUNNING
                log = (logs / f"{cell.name}.log").absolute() if logs else None
                self._running[number] = cell, slot.submit(compute, cell.work, slot.device, log)

    def _end_cells(self) -> None:
        for number, (cell, task) in list(self._running.items()):
            if task.done():
                del self._running[number]
                error = error_of(task)
                is_done = error is None and cell.is_done()
                self.status[cell.name] = Status.DONE if is_done else Status.FAILED
                if not is_done:
                    self.errors[cell.name] = error or "it ended without a result"

    def _stop_cells(self, slots: Sequence[Slot]) -> None:
        """Ask running cells to end; a cell that is finished by then counts."""
        for number in self._running:
            slots[number].stop()
        for slot in slots:
            slot.close()
        for cell, _ in self._running.values():
            self.status[cell.name] = Status.DONE if cell.is_done() else Status.STOPPED
        self._running.clear()


def compute(work: Work, device: str, log: Path | None) -> str | None:
    """Compute a cell, and return the text of its error, if there was one."""
    try:
        with _printing_to(log) if log else contextlib.nullcontext():
            work(device)
    except Exception as error:
        return in_words(error)
    return None


@contextlib.contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """Append the output of this process to a log; raise InvalidValueError if another process does, too."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "ab") as file, held(log):
        streams = {1: os.dup(1), 2: os.dup(2)}
        for number in streams:
            os.dup2(file.fileno(), number)
        try:
            yield
        except Exception:
            traceback.print_exc()
            raise
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, stream in streams.items():
                os.dup2(stream, number)
                os.close(stream)


def read_row(file: Path) -> Json | None:
    """Return the content of a result, or nothing if it is absent. Raise StudyError if it is damaged."""
    try:
        return read_json_object(file)
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise StudyError(f"'{file}' is damaged ({error}); delete it.") from error


def differences(before: Mapping[str, Any], now: Mapping[str, Any], where: str) -> str:
    """Return the names whose values differ, with both values; an empty text if none does."""
    names = [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]
    return "; ".join(f"{name}: {before.get(name)} {where}, {now.get(name)} now" for name in names)


def _begin() -> None:
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
