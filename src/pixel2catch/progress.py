"""Progress of work: a bar on a terminal, otherwise a line from time to time."""

import time

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

LONG_SECONDS = 600.0  #: Longer work is announced with its duration [s].
SETTLING_SECONDS = 3.0  #: Time after which the speed is used for an estimate [s].


class ProgressBar:
    """Percentage, time left and a line of text. Use it as a context around the work.

    A terminal shows a bar of at least 40 columns with the text below it and removes it at the end. Other
    outputs get a line at most every `line_seconds`. Work of more than ten minutes is announced.
    """

    def __init__(
        self, name: str, total: float, *, done: float = 0.0, console: Console, line_seconds: float = 20.0
    ) -> None:
        """Start from the amount of work that is done already."""
        self._name, self._total, self._console = name, total, console
        self._line_seconds, self._next_line = line_seconds, 0.0
        self._begin = self._now = done, time.monotonic()
        self._is_warm = self._is_announced = False
        self._text = Text("", no_wrap=True, overflow="ellipsis")
        self._left = TextColumn("")
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            TextColumn("{task.percentage:.1f} %"),
            TextColumn("{task.fields[left]}"),
            console=console,
            expand=True,
        )
        self._task = self._bar.add_task(name, total=total, left="")
        self._live = Live(Group(self._bar, self._text), console=console, transient=True)

    def __enter__(self) -> "ProgressBar":
        """Show the bar."""
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        self._live.stop()

    def show(self, done: float, text: str = "") -> None:
        """Show the amount of work done, and a text."""
        self._now = done, time.monotonic()
        if not self._is_warm:  # work before the first report includes compilation
            self._is_warm, self._begin = done > self._begin[0], self._now
        seconds = self._seconds_left()
        left = "" if seconds is None else f"{duration(seconds)} left"
        if seconds is not None and not self._is_announced and self._seconds() >= SETTLING_SECONDS:
            self._is_announced = True
            if seconds > LONG_SECONDS:
                self._console.print(f"{self._name}: this takes about {duration(seconds)}", markup=False)
        if self._console.is_terminal:
            self._bar.update(self._task, completed=done, left=left)
            self._text.plain = text or self._text.plain
        elif time.monotonic() >= self._next_line or done >= self._total:
            self._next_line = time.monotonic() + self._line_seconds
            parts = [f"{self._name}: {100 * done / self._total:.1f} %", text, left]
            self._console.print(" · ".join(filter(None, parts)), markup=False, soft_wrap=True)

    def _seconds_left(self) -> float | None:
        """Return the time left at the mean speed since the first report [s]; None before the second."""
        done = self._now[0] - self._begin[0]
        return self._seconds() * max(self._total - self._now[0], 0.0) / done if done > 0.0 else None

    def _seconds(self) -> float:
        return self._now[1] - self._begin[1]


def duration(seconds: float) -> str:
    """Return a duration as text."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 172_800 else f"{seconds / 86_400:.0f} days"
