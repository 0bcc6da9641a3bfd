"""Pages of work that must not wait for them: each in a process of its own that ends with it."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

import torch

from pixel2catch.interruption import end_with_parent
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.server import require_address

NICENESS = 10  #: Of the process of a page. Source: ours, below everything that has to keep a time.


@contextmanager
def page_process(serve: Callable[..., Any], cfg: PageCfg, *args: Any) -> Iterator[None]:
    """A process that calls `serve` with these arguments, and ends with the context.

    Raises:
        InvalidValueError: If this machine cannot listen on the page's address.
    """
    require_address(cfg)
    process = get_context("spawn").Process(target=_run, args=(serve, cfg, *args), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


def _run(serve: Callable[..., Any], *args: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the command's
    os.nice(NICENESS)
    end_with_parent()
    torch.set_num_threads(1)
    serve(*args)
