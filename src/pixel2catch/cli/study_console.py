"""What a person sees of a study: a live table on a terminal, else a line for every part that ends."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table

from pixel2catch.evaluation.comparison.jobs import Status
from pixel2catch.evaluation.comparison.plan import GROUPS

SUMMARY_SECONDS = 30.0
"""Time between two summaries where there is no terminal [s]."""

REFRESH_SECONDS = 1.0
"""Time between two pictures of the live table [s]."""

COLORS = {Status.RUNNING: "cyan", Status.DONE: "green", Status.FAILED: "red", Status.STOPPED: "yellow"}


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a training is.

    Attributes:
        transitions: Transitions learnt from.
        per_second: Transitions a second of the last update.
        success_rate: S.R. of the last update's episodes, with the stochastic policy; NaN if none had ended.
    """

    transitions: float = 0.0
    per_second: float = 0.0
    success_rate: float = float("nan")

    @classmethod
    def read(cls, log: Path) -> "Progress":
        """Progress from the last row of a training's `metrics.csv`; that of the start if there is none."""
        lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
        row = dict(zip(lines[0].split(","), lines[-1].split(","), strict=False)) if len(lines) > 1 else {}
        names = {
            "transitions": "transitions",
            "per_second": "transitions_per_second",
            "success_rate": "success_rate",
        }
        return cls(**{field: float(row[name]) for field, name in names.items() if row.get(name)})

    def describe(self, total: int) -> str:
        """In a few words: share of the transitions, S.R. and time left."""
        return f"{100 * self.transitions / total:.0f} %, S.R. {percent(self.success_rate)}"


class Board:
    """Shows a study on standard error while it runs; use as a context."""

    def __init__(self, logs: Mapping[str, Path], total: int) -> None:
        """Prepare to show.

        Args:
            logs: The `metrics.csv` of every training, by name of the part.
            total: Transitions of a training.
        """
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)
        self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None
        self._logs, self._total = logs, total
        self._shown: dict[str, Status] = {}
        self._next = 0.0

    def __enter__(self) -> "Board":
        """Begin to show."""
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the terminal as it was, with the last table."""
        if self._live:
            self._live.stop()

    def show(self, status: Mapping[str, Status]) -> None:
        """Show the status of all parts, as often as it is worth it."""
        changes = {name: now for name, now in status.items() if self._shown.get(name) is not now}
        self._shown = dict(status)
        if self._live and (changes or time.monotonic() >= self._next):
            self._next = time.monotonic() + REFRESH_SECONDS
            self._live.update(self._table(status), refresh=True)
        elif self._live is None:
            self._print(status, changes)

    def _print(self, status: Mapping[str, Status], changes: Mapping[str, Status]) -> None:
        """Print a line for every part that has ended, and a summary now and then."""
        num_done = sum(now is Status.DONE for now in status.values())
        for name, now in changes.items():
            if now not in (Status.WAITING, Status.RUNNING):
                self._say(f"{num_done}/{len(status)} · {name} {now.value}")
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + SUMMARY_SECONDS
            progress = self._progress()
            running = [name for name, now in status.items() if now is Status.RUNNING]
            parts = [
                f"{name} {progress[name].describe(self._total)}" if name in progress else name
                for name in running
            ]
            left = duration(self._seconds_left(status, progress))
            self._say(f"{num_done}/{len(status)} · {' · '.join(parts) or 'nothing runs'} · trainings: {left}")

    def _table(self, status: Mapping[str, Status]) -> Table:
        """One row for every training, with the evaluations of its policy."""
        progress = self._progress()
        left = duration(self._seconds_left(status, progress))
        table = Table(caption=f"trainings: {left}", caption_justify="left")
        for column in ("training", "state", "transitions [M]", "S.R. in training", "left", *GROUPS):
            table.add_column(column, justify="right" if "t" in column and "[" in column else "left")
        for name, each in progress.items():
            seconds = (self._total - each.transitions) / each.per_second if each.per_second else float("inf")
            is_running = status[name] is Status.RUNNING
            table.add_row(
                name,
                colored(status[name]),
                f"{each.transitions / 1e6:.1f} / {self._total / 1e6:.1f}",
                percent(each.success_rate),
                duration(seconds) if is_running else "",
                *(colored(status[f"{name}-{group}"]) for group in GROUPS),
            )
        return table

    def _progress(self) -> dict[str, Progress]:
        return {name: Progress.read(log) for name, log in self._logs.items()}

    def _seconds_left(self, status: Mapping[str, Status], progress: Mapping[str, Progress]) -> float:
        """Time that the trainings still take at the present speed of those that run [s]."""
        open_parts = [name for name in progress if status[name] in (Status.WAITING, Status.RUNNING)]
        speed = sum(progress[name].per_second for name in open_parts if status[name] is Status.RUNNING)
        rest = sum(max(0.0, self._total - progress[name].transitions) for name in open_parts)
        if rest == 0.0:
            return 0.0
        return rest / speed if speed else float("inf")

    def _say(self, text: str) -> None:
        self._console.print(text, markup=False)


def percent(rate: float) -> str:
    """A rate for people; a dash for NaN."""
    return "-" if rate != rate else f"{100 * rate:.1f} %"


def duration(seconds: float) -> str:
    """A time for people [s]."""
    if seconds == float("inf"):
        return "time left unknown"
    return f"{seconds:.0f} s left" if seconds < 100 else f"{seconds / 60:.0f} min left"


def colored(status: Status) -> str:
    """A status in its colour."""
    color = COLORS.get(status)
    return f"[{color}]{status.value}[/{color}]" if color else status.value
