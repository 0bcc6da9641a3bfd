"""How pages run: until Ctrl-C, or beside work that must not wait for them, in a process that ends with it."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, Protocol

import torch

from pixel2catch.interruption import StopRequest, end_with_parent
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.server import PageServer, require_address

NICENESS = 10  #: Of the process of a page that only shows. Source: ours, below all that has to keep a time.


class RunningPage(Protocol):
    """A page that plays something."""

    server: PageServer

    def run(self) -> None:
        """Play until `close`."""
        ...

    def close(self) -> None:
        """End `run`."""
        ...

    def free(self) -> None:
        """Free what the page holds, after `run`."""
        ...


def serve_until_interrupted(make_page: Callable[[], RunningPage]) -> None:
    """Make a page, say where it is, and run it until Ctrl-C."""
    with StopRequest() as stop, ThreadPoolExecutor(1) as pool:
        page = make_page()
        print(f"open {page.server.address} in a browser; Ctrl-C ends it", flush=True)
        playing = pool.submit(page.run)
        while not (stop.is_set or playing.done()):
            time.sleep(0.1)
        page.close()
        playing.exception()
        page.free()
        playing.result()


@contextmanager
def page_process(
    serve: Callable[..., Any], cfg: PageCfg, *args: Any, niceness: int = NICENESS
) -> Iterator[None]:
    """A process that calls `serve` with these arguments, and ends with the context.

    Raises:
        InvalidValueError: If this machine cannot listen on the page's address.
    """
    require_address(cfg)
    process = get_context("spawn").Process(target=_run, args=(niceness, serve, cfg, *args), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


def _run(niceness: int, serve: Callable[..., Any], *args: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the command's
    os.nice(niceness)
    end_with_parent()
    torch.set_num_threads(1)
    serve(*args)
