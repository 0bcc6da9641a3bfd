"""What commands begin with, and what they print: results on standard output, progress on standard error."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console

from pixel2catch.files import printable
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
    """Print a line of progress; the network's part of it may have control characters."""
    print(printable(text), file=sys.stderr, flush=True)


def progress_bar(name: str) -> ProgressBar:
    """A bar on standard error for work whose total is 1."""
    return ProgressBar(name, 1.0, console=Console(stderr=True, highlight=False))


def saying_changes() -> Callable[..., None]:
    """What says a line where it is not the one before, behind a time [s] if it is given one."""
    said = ""

    def hear(line: str, time: float | None = None) -> None:
        nonlocal said
        if line != said:
            said = line
            say(line if time is None else f"{time:7.1f} s  {line}")

    return hear


@contextmanager
def evaluating(name: str) -> Iterator[tuple[Callable[["Trials"], None], Callable[[float], None]]]:
    """Show on standard error how far the evaluation of something is, and its success rate so far.

    It yields what `assess` calls: of the trials of every round, and of the share of all rounds that is done.
    """
    successes = list[float]()

    def show(share: float) -> None:
        text = f"success rate so far {100 * sum(successes) / len(successes):.1f} %" if successes else ""
        bar.show(share, text)

    with progress_bar(name) as bar:
        yield lambda trials: successes.append(float(trials.record.is_success.float().mean())), show


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


def prepare(device: str, *, is_here: bool = True) -> str:
    """See that the device exists, if it is to be here, and name it in full; leave a CPU's cores to physics.

    Torch's own threads only make steps of these small tensors slower: measured with 100 environments on two
    cores, 0.7 to 2.0 thousand control steps a second with two threads, 2.5 thousand with one.

    Raises:
        DeviceUnavailableError: If CUDA was asked for and is absent.
    """
    import torch

    from pixel2catch.sim.factory import require_cuda

    if device == "cpu":
        torch.set_num_threads(1)
        return device
    index = torch.device(device).index or 0
    if is_here:
        require_cuda(device)
        torch.cuda.set_device(index)  # where PyTorch and Warp capture their graphs
    return f"cuda:{index}"
