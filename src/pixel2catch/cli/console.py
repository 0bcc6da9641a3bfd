"""What commands begin with, and what they print: results on standard output, progress on standard error."""

import os
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console

from pixel2catch.files import printable
from pixel2catch.own_files import OPTION, VARIABLE
from pixel2catch.progress import ProgressBar

TABLE_WIDTH = 100  #: Width of tables where there is no terminal [characters].


def results_console() -> Console:
    """Return the console for tables: as wide as the terminal or COLUMNS, else wide enough for every table."""
    console = Console(highlight=False)
    is_told = console.is_terminal or os.environ.get("COLUMNS", "").lstrip("0").isdigit()
    return console if is_told else Console(highlight=False, width=TABLE_WIDTH)


def say(text: str) -> None:
    """Print a line of progress; the network's part of it may have control characters."""
    print(printable(text), file=sys.stderr, flush=True)


def suggest(*words: object) -> None:
    """Print the command that one usually gives next."""
    files = filter(None, os.environ.get(VARIABLE, "").split(os.pathsep))
    imports = (word for file in files for word in (OPTION, file))
    say(f"next: pixel2catch {shlex.join(map(str, (*imports, *words)))}")


def progress_bar(name: str) -> ProgressBar:
    """Return a bar on standard error for work whose total is 1."""
    return ProgressBar(name, 1.0, console=Console(stderr=True, highlight=False))


def saying_changes() -> Callable[..., None]:
    """Return a function that prints a line if it differs from the one before, behind a time [s] if given."""
    said = ""

    def hear(line: str, time: float | None = None) -> None:
        nonlocal said
        if line != said:
            said = line
            say(line if time is None else f"{time:7.1f} s  {line}")

    return hear


@contextmanager
def working() -> Iterator[Callable[[str], None]]:
    """Yield a function that prints a step before it is done; a terminal shows that the last one goes on."""
    console = Console(stderr=True, highlight=False)
    with console.status("working"):
        yield lambda step: console.print(f"{step} ...", markup=False, soft_wrap=True)


def prepare(device: str, *, is_here: bool = True) -> str:
    """Require that the device exists, if it is to be here; return its full name.

    On a CPU torch gets one thread, because its own threads slow down steps of these small tensors: with 100
    environments on two cores, 2.5 thousand control steps a second instead of 0.7 to 2.0 thousand.
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
