"""What a person sees of a comparison: a live table on a terminal, else a line for every job that ends."""

import time
from collections.abc import Mapping
from contextlib import suppress
from math import isnan, nan
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table

from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.comparison.jobs import Status
from pixel2catch.evaluation.comparison.plan import GROUPS
from pixel2catch.evaluation.comparison.summary import read_metrics
from pixel2catch.progress import duration

SUMMARY_SECONDS = 30.0  #: Time between two summaries where there is no terminal [s].
REFRESH_SECONDS = 1.0  #: Time between two pictures of the live table [s].

COLUMNS = ("transitions", "transitions_per_second", "success_rate")
"""What is shown of a training: how much it has learnt from, how fast, and the S.R. of the last episodes."""

COLORS = {Status.RUNNING: "cyan", Status.DONE: "green", Status.FAILED: "red", Status.STOPPED: "yellow"}


def newest(log: Path) -> dict[str, float]:
    """What the last row of a training's `metrics.csv` says of `COLUMNS`; nothing before there is one."""
    with suppress(InvalidValueError):  # it is not there yet, or being written
        columns = read_metrics(log, COLUMNS)
        return {name: float(column[-1]) for name, column in columns.items() if len(column)}
    return {}


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
        progress, running = self._progress(), []
        for name in (name for name, now in status.items() if now is Status.RUNNING):
            if each := progress.get(name):
                name += f" {100 * each['transitions'] / self._total:.0f} %, S.R. {_percent(each)}"
            running.append(name)
        text = f"{done} · {' · '.join(running) or 'nothing runs'} · {self._left(status, progress)}"
        self._console.print(text, markup=False)

    def _table(self, status: Mapping[str, Status]) -> Table:
        progress = self._progress()
        table = Table(caption=self._left(status, progress), caption_justify="left")
        for column in ("training", "state", "transitions [M]", "S.R. in training", "left", *GROUPS):
            table.add_column(column, justify="right" if "[" in column else "left")
        for name, each in progress.items():
            is_running = status[name] is Status.RUNNING
            table.add_row(
                name,
                _colored(status[name]),
                f"{each.get('transitions', 0.0) / 1e6:.1f} / {self._total / 1e6:.1f}",
                _percent(each),
                _time_left(self._rest(each), each.get("transitions_per_second", 0.0)) if is_running else "",
                *(_colored(status[f"{name}-{group}"]) for group in GROUPS),
            )
        return table

    def _progress(self) -> dict[str, dict[str, float]]:
        return {name: newest(log) for name, log in self._logs.items()}

    def _rest(self, progress: Mapping[str, float]) -> float:
        """Transitions that a training has still to learn from."""
        return max(0.0, self._total - progress.get("transitions", 0.0))

    def _left(self, status: Mapping[str, Status], progress: Mapping[str, Mapping[str, float]]) -> str:
        """Time that all trainings still take at the present speed of those that run, in words."""
        running = [each for name, each in progress.items() if status[name] is Status.RUNNING]
        waiting = [each for name, each in progress.items() if status[name] is Status.WAITING]
        speed = sum(each.get("transitions_per_second", 0.0) for each in running)
        return f"trainings: {_time_left(sum(map(self._rest, (*running, *waiting))), speed)}"


def _percent(progress: Mapping[str, float]) -> str:
    rate = progress.get("success_rate", nan)
    return "-" if isnan(rate) else f"{100 * rate:.1f} %"


def _time_left(rest: float, speed: float) -> str:
    if rest and not speed > 0.0:
        return "time left unknown"
    return f"{duration(rest / speed if rest else 0.0)} left"


def _colored(status: Status) -> str:
    color = COLORS.get(status)
    return f"[{color}]{status.value}[/{color}]" if color else status.value
