"""End work early: by a signal (the first one in order, the second at once), or with the parent process."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from multiprocessing import parent_process, resource_tracker
from traceback import walk_stack
from types import FrameType

LONGEST_IMPORT = 10.0  #: Time for which a signal waits for the end of an import [s]. Source: ours.


class Terminated(KeyboardInterrupt):
    """A termination signal arrived; handled like Ctrl-C."""


def raise_on_termination() -> AbstractContextManager[None]:
    """Raise `Terminated` in this context, in the main thread, for a termination signal, after imports."""
    begin: dict[int, float] = {}

    def interrupt(number: int, frame: FrameType | None) -> None:
        is_importing = any(each.f_code.co_name == "_find_and_load" for each, _ in walk_stack(frame))
        # an exception in the initialisation of a compiled module can abort the process
        if is_importing and time.monotonic() - begin.setdefault(number, time.monotonic()) < LONGEST_IMPORT:
            threading.Timer(0.05, os.kill, (os.getpid(), number)).start()
        else:
            raise KeyboardInterrupt if number == signal.SIGINT else Terminated

    is_usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return on_signals(interrupt, signal.SIGTERM, signal.SIGHUP, *[signal.SIGINT] * is_usual)


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


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Start processes in this context that never receive Ctrl-C, also while they load."""
    resource_tracker.ensure_running()  # its start ends what is blocked
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """End this child process when its parent process ends for any reason."""

    def wait() -> None:
        if parent := parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
