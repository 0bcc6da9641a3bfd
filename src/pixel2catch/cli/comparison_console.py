"""What a person sees of a comparison: a live table on a terminal, else a line for every job that ends."""

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import inf, isinf, isnan, nan
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table

from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.comparison.jobs import Status
from pixel2catch.evaluation.comparison.plan import GROUPS
from pixel2catch.evaluation.comparison.summary import Columns, read_metrics
from pixel2catch.progress import duration

SUMMARY_SECONDS = 30.0  #: Time between two summaries where there is no terminal [s].
REFRESH_SECONDS = 1.0  #: Time between two pictures of the live table [s].

COLORS = {Status.RUNNING: "cyan", Status.DONE: "green", Status.FAILED: "red", Status.STOPPED: "yellow"}


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a training is."""

    transitions: float = 0.0  #: Transitions learnt from.
    transitions_per_second: float = 0.0  #: Transitions a second of the last update.
    #: S.R. of the last update's episodes, with the stochastic policy; NaN if none had ended.
    success_rate: float = nan

    @classmethod
    def read(cls, log: Path) -> "Progress":
        """Progress from the last row of a training's `metrics.csv`; that of the start if there is none."""
        columns: Columns = {}
        with suppress(InvalidValueError):  # it is not there yet, or being written
            columns = read_metrics(log, [*vars(cls())])
        last = {name: float(column[-1]) for name, column in columns.items() if len(column)}
        return cls(**{name: value for name, value in last.items() if not isnan(value)})


class ProgressTable:
    """Shows a comparison on standard error while it runs; use as a context."""

    def __init__(self, logs: Mapping[str, Path], total: int) -> None:
        """Prepare to show trainings, each by its `metrics.csv`; all have the same total of transitions."""
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)
        self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None
        self._logs, self._total = logs, total
        self._shown: dict[str, Status] = {}
        self._next = 0.0

    def __enter__(self) -> "ProgressTable":
        """Begin to show."""
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the terminal as it was, with the last table."""
        if self._live:
            self._live.stop()

    def show(self, status: Mapping[str, Status]) -> None:
        """Show the status of all jobs, as often as it is worth it."""
        changes = {name: now for name, now in status.items() if self._shown.get(name) is not now}
        self._shown = dict(status)
        if self._live and (changes or time.monotonic() >= self._next):
            self._next = time.monotonic() + REFRESH_SECONDS
            self._live.update(self._table(status), refresh=True)
        elif self._live is None:
            self._print(status, changes)

    def _print(self, status: Mapping[str, Status], changes: Mapping[str, Status]) -> None:
        done = f"{sum(now is Status.DONE for now in status.values())}/{len(status)}"
        for name, now in changes.items():
            if now not in (Status.WAITING, Status.RUNNING):
                self._console.print(f"{done} · {name} {now.value}", markup=False)
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + SUMMARY_SECONDS
        progress = self._progress()
        running = []
        for name in (name for name, now in status.items() if now is Status.RUNNING):
            if each := progress.get(name):
                name += f" {100 * each.transitions / self._total:.0f} %, S.R. {_percent(each.success_rate)}"
            running.append(name)
        left = _duration(self._seconds_left(status, progress))
        text = f"{done} · {' · '.join(running) or 'nothing runs'} · trainings: {left}"
        self._console.print(text, markup=False)

    def _table(self, status: Mapping[str, Status]) -> Table:
        progress = self._progress()
        left = _duration(self._seconds_left(status, progress))
        table = Table(caption=f"trainings: {left}", caption_justify="left")
        for column in ("training", "state", "transitions [M]", "S.R. in training", "left", *GROUPS):
            table.add_column(column, justify="right" if "[" in column else "left")
        for name, each in progress.items():
            speed = each.transitions_per_second
            table.add_row(
                name,
                _colored(status[name]),
                f"{each.transitions / 1e6:.1f} / {self._total / 1e6:.1f}",
                _percent(each.success_rate),
                _duration((self._total - each.transitions) / speed if speed else inf)
                if status[name] is Status.RUNNING
                else "",
                *(_colored(status[f"{name}-{group}"]) for group in GROUPS),
            )
        return table

    def _progress(self) -> dict[str, Progress]:
        return {name: Progress.read(log) for name, log in self._logs.items()}

    def _seconds_left(self, status: Mapping[str, Status], progress: Mapping[str, Progress]) -> float:
        """Time that the trainings still take at the present speed of those that run [s]."""
        running = [each for name, each in progress.items() if status[name] is Status.RUNNING]
        waiting = [each for name, each in progress.items() if status[name] is Status.WAITING]
        speed = sum(each.transitions_per_second for each in running)
        rest = sum(max(0.0, self._total - each.transitions) for each in (*running, *waiting))
        return (rest / speed if speed else inf) if rest else 0.0


def _percent(rate: float) -> str:
    return "-" if isnan(rate) else f"{100 * rate:.1f} %"


def _duration(seconds: float) -> str:
    if isinf(seconds):
        return "time left unknown"
    return f"{duration(seconds)} left"


def _colored(status: Status) -> str:
    color = COLORS.get(status)
    return f"[{color}]{status.value}[/{color}]" if color else status.value
