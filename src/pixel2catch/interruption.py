"""End work early: by a signal (the first one in order, the second at once), or with the parent process."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from types import FrameType
from typing import Any


class Terminated(KeyboardInterrupt):
    """A termination signal arrived; handled like Ctrl-C."""


@contextmanager
def raise_on_termination() -> Iterator[None]:
    """Raise `Terminated` in this context, in the main thread, when a termination signal arrives."""
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
    """Return the termination signals besides SIGINT; `nohup` sets SIGHUP to be ignored."""
    is_ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGTERM] if is_ignored else [signal.SIGTERM, signal.SIGHUP]


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


class StopRequest:
    """A request to stop by a signal. Use it as a context around the work."""

    def __init__(self) -> None:
        """Start without a request."""
        self.is_set = False
        self.by = ""  #: Name of the signal, such as SIGTERM.
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "StopRequest":
        """Install the handlers, if this is the main thread, the only one that receives signals."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, *_terminations()):
                self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous handlers."""
        while self._previous:
            number, handler = self._previous.popitem()
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.is_set, self.by = True, signal.Signals(number).name
        self.__exit__()


def end_with_parent() -> None:
    """End this child process when its parent process ends for any reason."""
    threading.Thread(target=_wait_for_end_of_parent, daemon=True).start()


def _wait_for_end_of_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
