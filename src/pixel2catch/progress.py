"""Progress of work: a bar on a terminal, otherwise a line from time to time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from threading import Event, Thread

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

ESTIMATE_SECONDS = 3600.0  #: The time left follows from the speed in this time [s].


class ProgressBar:
    """Percentage, time left and a line of text. Use it as a context around the work.

    A terminal shows a bar with the text below it and removes it at the end. Other outputs get a line at most
    every `line_seconds`.
    """

    def __init__(
        self, name: str, total: float, *, done: float = 0.0, console: Console, line_seconds: float = 20.0
    ) -> None:
        """Start from the amount of work that is done already."""
        self._console, self._line_seconds, self._next_line = console, line_seconds, 0.0
        self._text = Text("", no_wrap=True, overflow="ellipsis")
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            TextColumn("{task.percentage:.1f} %"),
            TimeRemainingColumn(),
            console=console,
            speed_estimate_period=ESTIMATE_SECONDS,
            expand=True,
        )
        self._bar.add_task(name, total=total, completed=done)  # pyright: ignore[reportArgumentType] (it takes fractions)
        self._live = Live(Group(self._bar, self._text), console=console, transient=True)

    def __enter__(self) -> "ProgressBar":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, done: float, text: str = "") -> None:
        """Show the amount of work done, and a text. The time left is known from the second call on."""
        task, now = self._bar.tasks[0], self._console.get_time()
        self._bar.update(task.id, completed=done)
        self._text.plain = text or self._text.plain
        if not self._console.is_terminal and (now >= self._next_line or task.finished):
            self._next_line = now + self._line_seconds
            left = "" if task.time_remaining is None else f"{timedelta(seconds=task.time_remaining)} left"
            parts = [f"{task.description}: {task.percentage:.1f} %", text, left]
            self._console.print(" · ".join(filter(None, parts)), markup=False, soft_wrap=True)


@contextmanager
def heartbeat(console: Console, seconds: float = 10.0) -> Iterator[Callable[[str], None]]:
    """Yield a function that begins a step; every `seconds` its name and time are printed until the next."""
    ended, step, begun = Event(), "", 0.0

    def begin(name: str) -> None:
        nonlocal step, begun
        step, begun = name, console.get_time()

    def run() -> None:
        while not ended.wait(seconds):
            if step:
                console.print(f"{step}: {console.get_time() - begun:.0f} s", markup=False, soft_wrap=True)

    Thread(target=run, daemon=True).start()
    try:
        yield begin
    finally:
        ended.set()
