"""Running a page: until Ctrl-C, or in a process of its own beside other work."""

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
from pixel2catch.viewer.server import PageServer, require_address
from pixel2catch.viewer.stage import Playback

NICENESS = 10  #: Niceness of the process of a page without a switch. Source: ours, below real-time work.


class PlayingPage(ABC):
    """A page that plays something on request, until it is closed."""

    def __init__(self, server: PageServer) -> None:
        """Wait for a request."""
        self.server = server  #: Its server.
        self.playback = Playback()  #: Pace of time.
        self._closed, self._wanted = Event(), Event()

    def begin(self) -> None:
        """Play from the beginning; interrupt what is played now."""
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
        """Free all resources, after `run`."""
        self.server.close()

    @abstractmethod
    def _play(self) -> None:
        """Play once what was requested."""


def serve_until_interrupted(make_page: Callable[[], PlayingPage]) -> None:
    """Make a page, print its address, and run it until Ctrl-C."""
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
    """Call `serve` with these arguments in a process that ends with the context.

    Raises:
        InvalidValueError: This machine cannot listen on the page's address.
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    os.nice(niceness)
    end_with_parent()
    torch.set_num_threads(1)
    serve(*args)
