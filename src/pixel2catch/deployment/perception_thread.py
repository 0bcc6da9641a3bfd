"""Perception beside the decisions: it looks at one image at a time, and nobody waits for it."""

from collections.abc import Callable
from concurrent.futures import Executor, Future, wait
from dataclasses import dataclass
from functools import partial
from typing import Any, final

from pixel2catch.camera.image import Box, Image
from pixel2catch.deployment.policy_pipeline import PolicyPipeline
from pixel2catch.perception.segmenter import Prompt
from pixel2catch.ros2.transport import Clock
from pixel2catch.scene.constants import CONTROL_DT

ROUNDING = 1e-9  #: Difference of two times that is none [s].

LONGEST_WAIT = 0.25 * CONTROL_DT
"""Time after which an image that waits is passed over for the next one [s].

Source: ours, from simulated looks of 27 to 110 ms: at a decision boxes are up to 4 ms younger in the mean
than with half a control step, and up to 22 ms younger than where whatever waits is looked at.
"""


@final
class _TimedResult(Future[Any]):
    """A result that is there when a clock says so [s]."""

    def __init__(self, result: object, due: float, clock: Clock) -> None:
        super().__init__()
        self.set_result(result)
        self._due, self._clock = due, clock

    def done(self) -> bool:
        return self._clock.now() >= self._due - ROUNDING

    def result(self, timeout: float | None = None) -> Any:
        if not self.done():
            self._clock.sleep_until(self._due)
        return super().result(timeout)


@final
class CallerExecutor(Executor):
    """Does a task at once, in the caller's thread; on the clock it takes as long as is said.

    For clocks that go on only while somebody waits, and for real ones where a task takes no longer than it
    takes.
    """

    def __init__(self, clock: Clock, seconds: Callable[[], float] = float) -> None:
        """Take so much time of a clock, asked for each task [s]; none if nothing is said."""
        self._clock, self._seconds = clock, seconds

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See `Executor.submit`; what the task raises is raised here."""
        due = self._clock.now() + self._seconds()
        return _TimedResult(fn(*args, **kwargs), due, self._clock)


@dataclass(frozen=True, kw_only=True)
class PerceptionResult:
    """One look at an image."""

    box: Box
    received: float  #: When the image was received [s].
    begin: float  #: When the look began [s].
    end: float  #: When it was done [s].


class ConcurrentPerception:
    """Looks at the newest images and has the pipeline remember what was seen.

    While an image is looked at, the newest of those that arrive waits. Where an image takes 60 ms, every
    second one of a camera of 30 Hz is looked at, as soon as it arrives.
    """

    def __init__(self, pipeline: PolicyPipeline, executor: Executor, clock: Clock) -> None:
        """Look at nothing yet; the executor looks at one image at a time, the clock is of their stamps."""
        self._pipeline, self._executor, self._clock = pipeline, executor, clock
        self._waiting: tuple[Image, float] | None = None
        self._work: tuple[Image, float, float, Future[Box]] | None = None
        self._later: Callable[[], None] | None = None

    @property
    def is_free(self) -> bool:
        """Whether no image is looked at."""
        return self._work is None

    @property
    def stamp(self) -> float | None:
        """When the image was taken that is looked at [s]; None if none is."""
        return None if self._work is None else self._work[0].stamp

    def wait(self, seconds: float) -> None:
        """Wait until the look is done, or for a real time [s]."""
        if self._work:
            wait((self._work[3],), seconds)

    def begin(self, prompt: Prompt | None) -> None:
        """A new throw begins; what is looked at now still belongs to the one before."""
        self._pipeline.forget()
        point = partial(self._pipeline.point, prompt)
        if self.is_free:
            point()
        else:
            self._later = point

    def offer(self, image: Image) -> None:
        """Have an image that has just arrived looked at, if no newer one comes before its turn."""
        self._waiting = (image, self._clock.now())

    def go_on(self) -> PerceptionResult | None:
        """Take what was seen, if a look is done and not at a throw before, and begin with the next image.

        Call it often.

        Raises:
            PerceptionError: The first image has the wrong size.
        """
        look = self._done()
        now = self._clock.now()
        if self._waiting and now - self._waiting[1] > LONGEST_WAIT:
            self._waiting = None
        if self._waiting and self.is_free:
            image, received = self._waiting
            self._waiting = None
            future = self._executor.submit(self._pipeline.perceive, image, now)
            future.add_done_callback(lambda _: self._pipeline.settle())  # there, while this one decides
            self._work = (image, received, now, future)
        return look

    def _done(self) -> PerceptionResult | None:
        """The look that is done; the pipeline remembers it."""
        if self._work is None or not self._work[3].done():
            return None
        _, received, begin, future = self._work
        self._work = None
        box = future.result()
        if self._later:
            self._later()
            self._later = None
            return None
        self._pipeline.remember(box)
        end = self._clock.now()
        return PerceptionResult(box=box, received=received, begin=begin, end=end)
