"""How far work is: a bar where a terminal shows it, else a line now and then."""

import time

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

LONG_SECONDS = 600.0  #: Work that takes longer is announced [s].
SETTLING_SECONDS = 3.0  #: Time from which on a speed is trusted [s].


class ProgressBar:
    """Percentage, time left and a line of text; use as a context around the work.

    On a terminal a bar, which fits into 40 columns and goes away at the end, with the text below it. Else a
    line of both at most every so many seconds. Work that takes longer than ten minutes is announced as soon
    as its speed is known.
    """

    def __init__(
        self, name: str, total: float, *, done: float = 0.0, console: Console, line_seconds: float = 20.0
    ) -> None:
        """Begin to count, from what is done already."""
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
        """Take the bar away."""
        self._live.stop()

    def show(self, done: float, text: str = "") -> None:
        """Show how much is done, and what is to be said of it."""
        self._now = done, time.monotonic()
        if not self._is_warm:  # What was compiled and read before the first report tells no speed.
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
        """Time that the rest takes at the mean speed since the first report [s]; none before the second."""
        done = self._now[0] - self._begin[0]
        return self._seconds() * max(self._total - self._now[0], 0.0) / done if done > 0.0 else None

    def _seconds(self) -> float:
        return self._now[1] - self._begin[1]


def duration(seconds: float) -> str:
    """A time in words."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 172_800 else f"{seconds / 86_400:.0f} days"
