"""When work ends early: by a signal (once: in order; twice: at once), or with its parent."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from types import FrameType
from typing import Any


class Terminated(KeyboardInterrupt):
    """A scheduler, a user or a closed terminal asked this process to end: as Ctrl-C, by another name."""


@contextmanager
def raise_on_termination() -> Iterator[None]:
    """End what runs in this context by `Terminated` where a termination signal comes, in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, _terminate) for number in _terminations()}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _terminations() -> list[signal.Signals]:
    """Signals that ask to end, beside Ctrl-C's; nohup has a closed terminal's ignored."""
    is_heard = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    return [signal.SIGTERM, signal.SIGHUP] if is_heard else [signal.SIGTERM]


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


class StopRequest:
    """Whether user, machine or a closed terminal has asked to stop. Use as a context around the work."""

    def __init__(self) -> None:
        """Nobody has asked yet."""
        self.is_set = False
        self.by = ""  #: Name of the signal that asked, such as SIGTERM.
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "StopRequest":
        """Listen, if in the main thread; signals reach no other."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, *_terminations()):
                self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: object) -> None:
        """Put the former handlers back."""
        while self._previous:
            number, handler = self._previous.popitem()
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.is_set, self.by = True, signal.Signals(number).name
        self.__exit__()


def end_with_parent() -> None:
    """Let a child process end when its parent has gone, however that went."""
    threading.Thread(target=_wait_for_end_of_parent, daemon=True).start()


def _wait_for_end_of_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
