"""How pages run: until Ctrl-C, or beside work that must not wait for them, in a process that ends with it."""

import os
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from threading import Event
from typing import Any

import torch

from pixel2catch.interruption import StopRequest, end_with_parent
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.playback import Playback
from pixel2catch.viewer.server import PageServer, require_address

NICENESS = 10  #: Of the process of a page that only shows. Source: ours, below all that has to keep a time.


class PlayingPage(ABC):
    """A page that plays something whenever that is asked for, until it is closed."""

    def __init__(self, server: PageServer) -> None:
        """Play nothing yet."""
        self.server = server  #: What serves it.
        self.playback = Playback()  #: How time goes.
        self._closed, self._wanted = Event(), Event()

    def begin(self) -> None:
        """Play from the beginning; what is played now is broken off."""
        self.playback.interrupt()
        self._wanted.set()

    def run(self) -> None:
        """Play until `close`."""
        torch.set_num_threads(1)
        while True:
            self._wanted.wait()
            self._wanted.clear()
            if self._closed.is_set():
                return
            self.playback.begin()
            self._play()

    def close(self) -> None:
        """End `run`."""
        self._closed.set()
        self.begin()

    def free(self) -> None:
        """Free what the page holds, after `run`."""
        self.server.close()

    @abstractmethod
    def _play(self) -> None:
        """Play what is asked for, once."""


def serve_until_interrupted(make_page: Callable[[], PlayingPage]) -> None:
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
