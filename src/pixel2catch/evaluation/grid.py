"""The cells of a study, and the one loop that computes those that are missing.

A cell is a call that writes a file. A cell whose file is there is not computed again, so an interrupted study
goes on with the same command. A cell that fails holds up only the cells that need its result.
"""

import contextlib
import fcntl
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from pixel2catch.errors import Pixel2CatchError, StudyError
from pixel2catch.evaluation.slots import Slot, error_of
from pixel2catch.files import read_json_object
from pixel2catch.interruption import StopRequest

Json = dict[str, Any]
Work = Callable[[str], None]


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
        """The cells without a result."""
        return [cell for cell in self._cells if self.status[cell.name] is not Status.DONE]

    @property
    def share_done(self) -> float:
        """Share of the cells that have ended."""
        ended = (Status.DONE, Status.FAILED)
        return sum(status in ended for status in self.status.values()) / max(len(self.status), 1)

    def run(
        self, slots: Sequence[Slot], watch: Callable[[], None] = lambda: None, logs: Path | None = None
    ) -> None:
        """Compute the missing cells, until no more can be computed.

        Args:
            slots: Where cells are computed; the first free slot of a kind takes the first ready cell.
            watch: Called after every look at the running cells.
            logs: Folder for what the cells print in other processes, a file `NAME.log` for each.

        Raises:
            KeyboardInterrupt: If the user stopped it; running cells have then ended in order.
        """
        is_here = any(slot.is_here for slot in slots)
        with contextlib.nullcontext() if is_here else StopRequest() as stop:
            try:
                while not (stop and stop.is_set):
                    self._start_cells(slots, logs)
                    watch()
                    if not self._running:
                        break
                    time.sleep(min(slot.poll_seconds for slot in slots))
                    self._end_cells()
            finally:
                self._stop_cells(slots)
                watch()
        if stop and stop.is_set and self.missing:
            raise KeyboardInterrupt

    def require_whole(self) -> None:
        """Raise an error that lists the cells that failed.

        Raises:
            StudyError: If any did.
        """
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
                log = (logs / f"{cell.name}.log").absolute() if logs and not slot.is_here else None
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
        with _printing_to(log):
            try:
                work(device)
            except Exception:
                traceback.print_exc()
                raise
    except (Pixel2CatchError, OSError) as error:
        return str(error)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


@contextlib.contextmanager
def _printing_to(log: Path | None) -> Iterator[None]:
    """Append what this process prints to a log, which only one process at a time may write."""
    if log is None:
        yield
        return
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "ab") as file, held(log):
        streams = {1: os.dup(1), 2: os.dup(2)}
        for number in streams:
            os.dup2(file.fileno(), number)
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, stream in streams.items():
                os.dup2(stream, number)
                os.close(stream)


@contextlib.contextmanager
def held(path: Path) -> Iterator[None]:
    """Hold a file or a folder for this process.

    Raises:
        StudyError: If another process holds it.
    """
    with open(path / ".lock" if path.is_dir() else path, "ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StudyError(
                f"'{path}' is in use by another process of this study; wait for it or end it, then run the "
                "command again."
            ) from error
        yield


def read_row(file: Path) -> Json | None:
    """Return the content of a result, or nothing if it is absent.

    Raises:
        StudyError: If it is damaged.
    """
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
