"""What a person sees while a command works for minutes without a count: the step, and the time it takes."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from pixel2catch.cli.console import say

BEAT_SECONDS = 20.0
"""Time between two signs of life where there is no terminal [s]."""


@contextmanager
def working() -> Iterator[Callable[[str], None]]:
    """Show steps on standard error: a live line on a terminal, else a line for each and a sign of life.

    Yields:
        Function that is told a step before it is done.
    """
    console = Console(stderr=True, highlight=False)
    with _live(console) if console.is_terminal else _plain() as report:
        yield report


@contextmanager
def _live(console: Console) -> Iterator[Callable[[str], None]]:
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        tasks = []

        def report(step: str) -> None:
            for task in tasks:
                progress.update(task, total=1, completed=1)
            tasks.append(progress.add_task(step, total=None))

        yield report
        for task in tasks:
            progress.update(task, total=1, completed=1)


@contextmanager
def _plain() -> Iterator[Callable[[str], None]]:
    begun: list[tuple[str, float]] = []
    is_over = threading.Event()

    def report(step: str) -> None:
        begun.append((step, time.monotonic()))
        say(f"{step} ...")

    def live() -> None:
        while not is_over.wait(BEAT_SECONDS):
            for step, start in begun[-1:]:
                say(f"{step}: {time.monotonic() - start:.0f} s so far")

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        is_over.set()
        thread.join()
