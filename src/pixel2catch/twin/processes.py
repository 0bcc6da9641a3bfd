"""Processes that the twin starts: they end when it does, however it ends."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import Any

from pixel2catch.servo.process import set_niceness

FIRST, SECOND, LAST = -10, -5, 10
"""Niceness of physics and wires, of the camera, and of the page. Source: ours."""


def obey_parent(niceness: int) -> None:
    """Call this first in such a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the twin's
    set_niceness(niceness)
    Thread(target=_end_with_parent, daemon=True).start()


@contextmanager
def child(function: Callable[..., Any], *args: Any) -> Iterator[None]:
    """Run a function in a process of its own as long as the context lasts."""
    process = get_context("spawn").Process(target=function, args=args, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
