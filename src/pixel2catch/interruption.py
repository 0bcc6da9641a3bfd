"""End work early: by a signal (the first one in order, the second at once), or with the parent process."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from multiprocessing import parent_process
from types import FrameType


class Terminated(KeyboardInterrupt):
    """A termination signal arrived; handled like Ctrl-C."""


def raise_on_termination() -> AbstractContextManager[None]:
    """Raise `Terminated` in this context, in the main thread, when a termination signal arrives."""

    def terminate(number: int, frame: FrameType | None) -> None:
        raise Terminated

    return on_signals(terminate, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def on_signals(handler: Callable[[int, FrameType | None], None], *numbers: signal.Signals) -> Iterator[None]:
    """Call a handler in this context for signals, or else for each that ends a program in order.

    Only the main thread receives signals. A SIGHUP that is ignored, as by `nohup`, stays ignored.
    """
    is_main, previous = threading.current_thread() is threading.main_thread(), {}
    for number in (numbers or (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)) if is_main else ():
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            previous[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


class StopRequest(ExitStack):
    """A request to stop by a signal. Use it as a context around the work."""

    def __init__(self) -> None:
        super().__init__()
        self.is_set = False
        self.by = ""  #: Name of the signal, such as SIGTERM.

    def __enter__(self) -> "StopRequest":
        """Handle the first signal; later ones act as before."""
        self.enter_context(on_signals(self._request))
        return self

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.is_set, self.by = True, signal.Signals(number).name
        self.close()


def end_with_parent() -> None:
    """End this child process when its parent process ends for any reason."""

    def wait() -> None:
        if parent := parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
