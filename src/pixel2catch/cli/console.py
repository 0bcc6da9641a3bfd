"""What the commands print: results on standard output, progress on standard error."""

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    from pixel2catch.evaluation.protocol import Trials

TABLE_WIDTH = 100
"""Width of tables where there is no terminal [characters]."""


def results_console() -> Console:
    """The console for tables: as wide as the terminal, or wide enough for every table."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=TABLE_WIDTH)


def say(text: str) -> None:
    """Print a line of progress."""
    print(text, file=sys.stderr, flush=True)


def round_reporter(name: str, num_rounds: int) -> Callable[["Trials"], None]:
    """Function that prints a line after every round of an evaluation.

    Args:
        name: What is evaluated.
        num_rounds: Rounds in all.
    """
    successes: list[float] = []

    def report(trials: "Trials") -> None:
        successes.append(float(trials.record.is_success.float().mean()))
        mean = 100 * sum(successes) / len(successes)
        say(f"{name}: round {len(successes)} of {num_rounds}, success rate so far {mean:.1f} %")

    return report
