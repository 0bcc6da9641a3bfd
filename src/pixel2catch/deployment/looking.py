"""Perception beside the decisions: it looks at one image at a time, and nobody waits for it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from pixel2catch.deployment.brain import Brain
from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.worker import Worker
from pixel2catch.perception.extractor import CameraFrame, Extraction
from pixel2catch.perception.segmenter import Prompt
from pixel2catch.robot.constants import CONTROL_DT

LONGEST_WAIT = 0.25 * CONTROL_DT
"""Time after which an image that waits is passed over for the next one [s].

Source: ours, from simulated looks of 27 to 110 ms: at a decision boxes are up to 4 ms younger in the mean
than with half a control step, and up to 22 ms younger than where whatever waits is looked at.
"""


@dataclass(frozen=True, kw_only=True)
class Look:
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


class Looking:
    """Looks at the newest images and has the brain remember what was seen.

    While an image is looked at, the newest of those that arrive waits. Where an image takes 60 ms, every
    second one of a camera of 30 Hz is looked at, as soon as it arrives.
    """

    def __init__(self, brain: Brain, worker: Worker[Extraction], clock: Clock) -> None:
        """Look at nothing yet.

        Args:
            brain: Perception, and what remembers.
            worker: Who looks.
            clock: The clock of the images' stamps.
        """
        self._brain, self._worker, self._clock = brain, worker, clock
        self._waiting: tuple[CameraFrame, float] | None = None
        self._work: tuple[CameraFrame, float] | None = None
        self._later: Callable[[], None] | None = None

    def begin(self, prompt: Prompt | None) -> None:
        """A new throw begins; what is looked at now still belongs to the one before.

        Args:
            prompt: Where the operator points, if he does.
        """
        self._brain.forget()
        point = partial(self._brain.point, prompt)
        if self._worker.is_free:
            point()
        else:
            self._later = point

    def offer(self, frame: CameraFrame) -> None:
        """Have an image that has just arrived looked at, if no newer one comes before its turn."""
        self._waiting = (frame, self._clock.now())

    def go_on(self) -> Look | None:
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
            self._worker.start(partial(self._brain.perceive, frame, now))
        return look

    def _done(self) -> Look | None:
        """The look that is done; the brain remembers it."""
        seen = self._worker.fetch()
        if seen is None or self._work is None:
            return None
        frame, begin = self._work
        self._work = None
        if self._later:
            self._later()
            self._later = None
            return None
        self._brain.remember(frame, seen)
        end = self._clock.now()
        return Look(frame=frame, seen=seen, took=end - begin, end=end)
