"""End work early: by a signal (the first one in order, the second at once), or with the parent process."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from types import FrameType
from typing import Any

Handlers = dict[signal.Signals, Any]


class Terminated(KeyboardInterrupt):
    """A termination signal arrived; handled like Ctrl-C."""


@contextmanager
def raise_on_termination() -> Iterator[None]:
    """Raise `Terminated` in this context, in the main thread, when a termination signal arrives."""
    previous = _installed(_terminations(), _terminate)
    try:
        yield
    finally:
        _restore(previous)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


def _terminations() -> list[signal.Signals]:
    """Return the termination signals besides SIGINT; `nohup` sets SIGHUP to be ignored."""
    is_ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGTERM] if is_ignored else [signal.SIGTERM, signal.SIGHUP]


def _installed(numbers: list[signal.Signals], handler: Callable[[int, FrameType | None], None]) -> Handlers:
    """Set a handler in the main thread, the only one that receives signals; return the previous handlers."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {number: signal.signal(number, handler) for number in numbers}


def _restore(handlers: Handlers) -> None:
    while handlers:
        signal.signal(*handlers.popitem())


class StopRequest:
    """A request to stop by a signal. Use it as a context around the work."""

    def __init__(self) -> None:
        """Start without a request."""
        self.is_set = False
        self.by = ""  #: Name of the signal, such as SIGTERM.
        self._previous: Handlers = {}

    def __enter__(self) -> "StopRequest":
        """Install the handlers."""
        self._previous = _installed([signal.SIGINT, *_terminations()], self._request)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous handlers."""
        _restore(self._previous)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.is_set, self.by = True, signal.Signals(number).name
        _restore(self._previous)


def end_with_parent() -> None:
    """End this child process when its parent process ends for any reason."""

    def wait() -> None:
        if parent := parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
