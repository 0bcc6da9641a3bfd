"""Perception beside the decisions: it looks at one image at a time, and nobody waits for it."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar, final

from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.perception.extractor import CameraFrame, Extraction
from pixel2catch.perception.segmenter import Prompt
from pixel2catch.ros2.transport import Clock
from pixel2catch.scene.constants import CONTROL_DT

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


LONGEST_WAIT = 0.25 * CONTROL_DT
"""Time after which an image that waits is passed over for the next one [s].

Source: ours, from simulated looks of 27 to 110 ms: at a decision boxes are up to 4 ms younger in the mean
than with half a control step, and up to 22 ms younger than where whatever waits is looked at.
"""


@dataclass(frozen=True, kw_only=True)
class PerceptionResult:
    """One look at an image.

    Attributes:
        frame: The image.
        seen: What was seen.
        took: How long it took [s].
        end: When it was done [s].
    """

    frame: CameraFrame
    seen: Extraction
    took: float
    end: float


class ConcurrentPerception:
    """Looks at the newest images and has the pipeline remember what was seen.

    While an image is looked at, the newest of those that arrive waits. Where an image takes 60 ms, every
    second one of a camera of 30 Hz is looked at, as soon as it arrives.
    """

    def __init__(self, pipeline: PolicyPipeline, worker: Worker[Extraction], clock: Clock) -> None:
        """Look at nothing yet.

        Args:
            pipeline: Perception, and what remembers.
            worker: Who looks.
            clock: The clock of the images' stamps.
        """
        self._pipeline, self._worker, self._clock = pipeline, worker, clock
        self._waiting: tuple[CameraFrame, float] | None = None
        self._work: tuple[CameraFrame, float] | None = None
        self._later: Callable[[], None] | None = None

    def begin(self, prompt: Prompt | None) -> None:
        """A new throw begins; what is looked at now still belongs to the one before.

        Args:
            prompt: Where the operator points, if he does.
        """
        self._pipeline.forget()
        point = partial(self._pipeline.point, prompt)
        if self._worker.is_free:
            point()
        else:
            self._later = point

    def offer(self, frame: CameraFrame) -> None:
        """Have an image that has just arrived looked at, if no newer one comes before its turn."""
        self._waiting = (frame, self._clock.now())

    def go_on(self) -> PerceptionResult | None:
        """Take what was seen, if a look is done, and begin with the next image; call it often.

        Returns:
            The look that is done; none if there is none, or if it was at a throw before.

        Raises:
            PerceptionError: The first image has the wrong size.
        """
        look = self._done()
        now = self._clock.now()
        if self._waiting and now - self._waiting[1] > LONGEST_WAIT:
            self._waiting = None
        if self._waiting and self._worker.is_free:
            frame, _ = self._waiting
            self._waiting, self._work = None, (frame, now)
            self._worker.start(partial(self._pipeline.perceive, frame, now))
        return look

    def _done(self) -> PerceptionResult | None:
        """The look that is done; the pipeline remembers it."""
        seen = self._worker.fetch()
        if seen is None or self._work is None:
            return None
        frame, begin = self._work
        self._work = None
        if self._later:
            self._later()
            self._later = None
            return None
        self._pipeline.remember(frame, seen)
        end = self._clock.now()
        return PerceptionResult(frame=frame, seen=seen, took=end - begin, end=end)
