"""Who does the work of perception: the caller itself, or a thread beside it."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar, final

from pixel2catch.deployment.clock import Clock

ROUNDING = 1e-9
"""Difference of two times that is none [s]."""

Result = TypeVar("Result")


class Worker(ABC, Generic[Result]):
    """Does one task at a time; give it the next when the result of the last one was fetched."""

    @property
    @abstractmethod
    def is_free(self) -> bool:
        """Whether there is no task whose result was not fetched."""

    @abstractmethod
    def start(self, task: Callable[[], Result]) -> None:
        """Begin with a task."""

    @abstractmethod
    def fetch(self) -> Result | None:
        """The result of the task if it is done, once; what the task raised is raised here."""

    @abstractmethod
    def finish(self) -> Result:
        """Wait for the result of the task and fetch it."""

    def close(self) -> None:
        """Wait for what is in work, and end."""


@final
class CallerWorker(Worker[Result]):
    """Does a task at once, in the caller's thread; on the clock it takes as long as is said.

    For clocks that go on only while somebody waits, and for real ones where a task takes no longer than it
    takes.
    """

    def __init__(self, clock: Clock, seconds: Callable[[], float] = float) -> None:
        """Wait for tasks.

        Args:
            clock: Whose time it takes.
            seconds: How much of it, asked for each task [s]; none if absent.
        """
        self._clock, self._seconds = clock, seconds
        self._result: Result | None = None
        self._due = 0.0

    @property
    def is_free(self) -> bool:
        """See `Worker.is_free`."""
        return self._result is None

    def start(self, task: Callable[[], Result]) -> None:
        """See `Worker.start`."""
        self._due = self._clock.now() + self._seconds()
        self._result = task()

    def fetch(self) -> Result | None:
        """See `Worker.fetch`."""
        if self._clock.now() < self._due - ROUNDING:
            return None
        result, self._result = self._result, None
        return result

    def finish(self) -> Result:
        """See `Worker.finish`."""
        self._clock.sleep_until(self._due)
        result, self._result = self._result, None
        assert result is not None, "start a task first"
        return result


@final
class ThreadWorker(Worker[Result]):
    """Does a task in a thread of its own, while the caller goes on."""

    def __init__(self) -> None:
        """Start the thread."""
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="perception")
        self._future: Future[Result] | None = None

    @property
    def is_free(self) -> bool:
        """See `Worker.is_free`."""
        return self._future is None

    def start(self, task: Callable[[], Result]) -> None:
        """See `Worker.start`."""
        self._future = self._thread.submit(task)

    def fetch(self) -> Result | None:
        """See `Worker.fetch`."""
        return self.finish() if self._future and self._future.done() else None

    def finish(self) -> Result:
        """See `Worker.finish`."""
        future, self._future = self._future, None
        assert future is not None, "start a task first"
        return future.result()

    def close(self) -> None:
        """See `Worker.close`."""
        self._thread.shutdown()
