"""SAM 2 and background subtraction on the same images: which result is used, and how far they agree.

SAM 2 recognises the object by its appearance, whatever else moves, but may lose it, return the whole image,
or be late. Background subtraction is always in time. Both get the same prompts. Where they differ, the result
that continues the object's flight is used.
"""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import StrEnum

from pixel2catch.camera.image import Edges, Mask, Pixels
from pixel2catch.perception.regions import Blob, PlausibilityCfg, find_blobs, is_jump
from pixel2catch.perception.segmenter import (
    BoxPrompt,
    ImageMotion,
    ImageTrack,
    Segmentation,
    Segmenter,
)
from pixel2catch.scene.constants import CONTROL_DT

LEAST_AGREEMENT = 0.3
"""Smallest overlap (IoU) of two boxes of one thing. Source: ours: boxes of 20 px that are 5 px off in both
directions have 0.39, and half of a box and the whole 0.5."""

PATIENCE = 3
"""Images in a row in which only background subtraction is used, before SAM 2 starts again. Source: ours."""

LONGEST_WAIT = 0.6 * CONTROL_DT
"""Longest time of an image of a camera [s]. Source: ours: leaves a third for box, features and policy."""


class Source(StrEnum):
    """Which result was used."""

    BOTH = "both"
    SAM2 = "sam2"
    BACKGROUND = "background"


class Doubt(StrEnum):
    """Why not both were used; the first reason that applies."""

    FAILED = "sam2 failed"
    LATE = "sam2 late"
    LOST = "sam2 lost it"
    IMPLAUSIBLE = "sam2 implausible"
    ALONE = "background lost it"
    DISAGREEMENT = "disagreement"


@dataclass(frozen=True, kw_only=True)
class LastPlace(ImageTrack):
    """Last box and motion of the object."""

    box: Edges  #: Its box there [px].

    @classmethod
    def of(cls, prompt: BoxPrompt, limits: PlausibilityCfg) -> "LastPlace":
        """Return the place of a prompt."""
        return cls(center=prompt.center, box=prompt.box, limits=limits)

    def after(self, blob: Blob | None) -> "LastPlace":
        """Return the place after the next image, in which the object is a region, or not seen."""
        if blob is None:
            return replace(self, num_missed=self.num_missed + 1)
        return LastPlace(**vars(self.seen(blob.center)), box=blob.box)

    def likeliest(self, mask: Mask | None) -> Blob | None:
        """Return the largest region of a mask that can be the object in the next image; None if none can."""
        blobs = [] if mask is None else find_blobs(mask)
        sized = (blob for blob in blobs if blob.is_plausible(self.limits))
        return next((blob for blob in sized if not self._is_jump(blob)), None)

    def _is_jump(self, blob: Blob) -> bool:
        return is_jump(self.limits, blob.box, self.box, self.num_missed + 1.0)


class SideBySide(Segmenter):
    """Follows the object with SAM 2 in a thread and with background subtraction in the caller's.

    A result is used if it has the size of an object and is no jump. The mask is SAM 2's where that is used.
    The score is the overlap (IoU) of both boxes, 0 without two. After `PATIENCE` images in which it alone was
    wrong, SAM 2 starts again at the other's box. After a wrong result it is not used alone until both agree.
    """

    uses_motion = True

    def __init__(self, sam2: Segmenter, background: Segmenter, longest_wait: float | None = None) -> None:
        """Start without an object; set the longest time of an image [s], None to wait for SAM 2."""
        self._sam2, self._background, self._longest_wait = sam2, background, longest_wait
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="sam2")
        self._work: Future[Segmentation] | None = None
        self._last: LastPlace | None = None
        self._num_unused, self._is_trusted = 0, True

    def set_limits(self, limits: PlausibilityCfg) -> None:
        """See `Segmenter.set_limits`."""
        super().set_limits(limits)
        self._background.set_limits(limits)

    def start(self, image: Pixels, prompt: BoxPrompt, motion: ImageMotion | None = None) -> Segmentation:
        """See `Segmenter.start`."""
        begin = time.perf_counter()
        self._restart(image, prompt)
        self._last = LastPlace.of(prompt, self.limits)
        self._num_unused, self._is_trusted = 0, True
        other = self._background.start(image, prompt, motion)
        return self._judged(image, self._last, other, begin, is_submitted=True)

    def track(self, image: Pixels, motion: ImageMotion | None = None) -> Segmentation:
        """See `Segmenter.track`; SAM 2 skips this image if it still processes an earlier one."""
        begin = time.perf_counter()
        last = self._last
        if last is None:
            return self._background.track(image, motion)
        is_submitted = self._is_free()
        if is_submitted:
            self._work = self._thread.submit(self._sam2.track, self._kept(image))
        return self._judged(
            image, last, self._background.track(image, motion), begin, is_submitted=is_submitted
        )

    def settle(self) -> None:
        """See `Segmenter.settle`."""
        self._background.settle()

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._cancel()
        self._thread.submit(self._sam2.reset)
        self._background.reset()
        self._last = None

    def _restart(self, image: Pixels, prompt: BoxPrompt) -> None:
        """Start SAM 2 again after its current image, whose result is discarded."""
        self._cancel()
        self._work = self._thread.submit(self._sam2.start, self._kept(image), prompt)

    def _cancel(self) -> None:
        if self._work is not None:
            self._work.cancel()
            self._work = None

    def _is_free(self) -> bool:
        """Whether SAM 2 is idle; without a time limit, wait until then."""
        if self._work is not None and self._longest_wait is None:
            self._work.exception()
        return self._work is None or self._work.done()

    def _kept(self, image: Pixels) -> Pixels:
        """An image that SAM 2 may read longer than the caller leaves it unchanged."""
        return image if self._longest_wait is None else image.copy()

    def _result(self, begin: float) -> Segmentation | Doubt:
        """SAM 2's result for the submitted image, or why there is none in time."""
        assert self._work is not None
        left = None if self._longest_wait is None else begin + self._longest_wait - time.perf_counter()
        try:
            return self._work.result(left if left is None else max(left, 0.0))
        except TimeoutError:
            return Doubt.LATE
        except RuntimeError:  # of CUDA: background subtraction goes on
            return Doubt.FAILED

    def _judged(
        self, image: Pixels, last: LastPlace, other: Segmentation, begin: float, *, is_submitted: bool
    ) -> Segmentation:
        """Choose a result, and update the state."""
        seen = self._result(begin) if is_submitted else Doubt.LATE
        choice = choose(last, seen, other.mask, is_trusted=self._is_trusted)
        self._last = last.after(choice.blob)
        if seen is not Doubt.LATE:
            is_wrong = choice.source is Source.BACKGROUND
            self._num_unused = self._num_unused + 1 if is_wrong else 0
            self._is_trusted &= not is_wrong and choice.doubt is not Doubt.IMPLAUSIBLE
            self._is_trusted |= choice.source is Source.BOTH
        if choice.blob is not None and self._num_unused >= PATIENCE:
            self._restart(image, BoxPrompt(box=choice.blob.box))
            self._num_unused = 0
        return Segmentation(
            mask=None if choice.blob is None else choice.blob.mask(),
            score=choice.overlap,
            source=choice.source or "",
            doubt=choice.doubt or "",
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """The result that is used for an image."""

    blob: Blob | None  #: Its pixels; None if it is not found.
    source: Source | None  #: Whose they are.
    doubt: Doubt | None  #: Why they are not of both.
    overlap: float  #: Intersection over union of both boxes, 0 where there are no two.


def choose(
    last: LastPlace, seen: Segmentation | Doubt, other: Mask | None, *, is_trusted: bool = True
) -> Choice:
    """Choose between the result of SAM 2, or why there is none, and the mask of background subtraction.

    A trusted SAM 2 can be used alone, and gives the mask where both agree.
    """
    motion, sam2 = last.likeliest(other), None
    if isinstance(seen, Segmentation):
        sam2 = last.likeliest(seen.mask)
        doubt = Doubt.LOST if seen.mask is None else Doubt.IMPLAUSIBLE
    else:
        doubt = seen
    if sam2 is None:
        return Choice(blob=motion, source=motion and Source.BACKGROUND, doubt=doubt, overlap=0.0)
    if motion is None:
        blob, source = (sam2, Source.SAM2) if is_trusted else (None, None)
        return Choice(blob=blob, source=source, doubt=Doubt.ALONE, overlap=0.0)
    overlap = _overlap(sam2, motion)
    if overlap >= LEAST_AGREEMENT:
        blob = sam2 if is_trusted else motion  # noise agrees once by chance
        return Choice(blob=blob, source=Source.BOTH, doubt=None, overlap=overlap)
    is_sam2 = is_trusted and sam2.distance(last.expected) <= motion.distance(last.expected)
    blob, source = (sam2, Source.SAM2) if is_sam2 else (motion, Source.BACKGROUND)
    return Choice(blob=blob, source=source, doubt=Doubt.DISAGREEMENT, overlap=overlap)


def _overlap(blob: Blob, other: Blob) -> float:
    """Intersection over union of two boxes, 0 to 1."""
    (left, top, right, bottom), (x, y, x_end, y_end) = blob.box, other.box
    shared = max(min(right, x_end) - max(left, x), 0.0) * max(min(bottom, y_end) - max(top, y), 0.0)
    return shared / (blob.width * blob.height + other.width * other.height - shared)
