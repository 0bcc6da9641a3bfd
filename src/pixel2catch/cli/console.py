"""What the commands print: results on standard output, progress on standard error."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console

from pixel2catch.progress import ProgressBar

if TYPE_CHECKING:
    from pixel2catch.evaluation.protocol import Trials

TABLE_WIDTH = 100  #: Width of tables where there is no terminal [characters].


def results_console() -> Console:
    """The console for tables: as wide as the terminal or COLUMNS, else wide enough for every table."""
    console = Console(highlight=False)
    is_told = console.is_terminal or os.environ.get("COLUMNS", "").isdigit()
    return console if is_told else Console(highlight=False, width=TABLE_WIDTH)


def say(text: str) -> None:
    """Print a line of progress."""
    print(text, file=sys.stderr, flush=True)


def say_on_terminal(text: str) -> None:
    """Print a line for somebody who looks at it; nothing into files and pipes."""
    if sys.stderr.isatty():
        say(text)


class EvaluationProgress:
    """How far an evaluation of something is: the steps of its rounds, and the success rate so far."""

    def __init__(self, bar: ProgressBar) -> None:
        """Show it in a bar whose total is 1."""
        self._bar = bar
        self._successes: list[float] = []

    def round(self, trials: "Trials") -> None:
        """Add the trials of a round."""
        self._successes.append(float(trials.record.is_success.float().mean()))

    def share(self, share: float) -> None:
        """Show a share of all rounds as done."""
        mean = 100 * sum(self._successes) / max(len(self._successes), 1)
        self._bar.show(share, f"success rate so far {mean:.1f} %" if self._successes else "")


@contextmanager
def evaluating(name: str) -> Iterator[EvaluationProgress]:
    """Show on standard error how far the evaluation of something is."""
    with ProgressBar(name, 1.0, console=Console(stderr=True, highlight=False)) as bar:
        yield EvaluationProgress(bar)


@contextmanager
def working() -> Iterator[Callable[[str], None]]:
    """Show steps on standard error, a line for each, and on a terminal that the last one goes on.

    It yields a function that is told a step before it is done.
    """
    console = Console(stderr=True, highlight=False)
    with console.status("working"):

        def report(step: str) -> None:
            console.print(f"{step} ...", markup=False, soft_wrap=True)

        yield report
