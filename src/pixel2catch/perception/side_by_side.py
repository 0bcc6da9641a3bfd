"""SAM 2 and background subtraction on the same images: who is believed, and how far they agree.

SAM 2 knows the object by its look, whatever else moves, but may lose it, take the whole image for it, or come
late. Background subtraction is always in time. Both are told the same; where they part, the one is believed
that continues the object's flight.
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
"""Overlap of two boxes, of 1, from which they are of one thing. Source: ours: boxes of 20 px that are 5 px
off in both directions have 0.39, and half of a box and the whole 0.5."""

PATIENCE = 3
"""Images in a row in which SAM 2 is not believed and the other is, before it is told anew. Source: ours."""

LONGEST_WAIT = 0.6 * CONTROL_DT
"""Time that an image of a camera may take [s]. Source: ours: leaves a third for box, features and policy."""


class Source(StrEnum):
    """Who was believed."""

    BOTH = "both"
    SAM2 = "sam2"
    BACKGROUND = "background"


class Doubt(StrEnum):
    """Why not both were believed; the first that holds."""

    FAILED = "sam2 failed"
    LATE = "sam2 late"
    LOST = "sam2 lost it"
    IMPLAUSIBLE = "sam2 implausible"
    ALONE = "background lost it"
    DISAGREEMENT = "disagreement"


@dataclass(frozen=True, kw_only=True)
class LastPlace(ImageTrack):
    """Where the object was last, and how it moved."""

    box: Edges  #: Its box there [px].

    @classmethod
    def of(cls, prompt: BoxPrompt, limits: PlausibilityCfg) -> "LastPlace":
        """Where a prompt says."""
        return cls(center=prompt.center, box=prompt.box, limits=limits)

    def after(self, blob: Blob | None) -> "LastPlace":
        """The place after the next image, in which it is this region, or none."""
        if blob is None:
            return replace(self, num_missed=self.num_missed + 1)
        return LastPlace(**vars(self.seen(blob.center)), box=blob.box)

    def likeliest(self, mask: Mask | None) -> Blob | None:
        """The largest region of a mask that can be the object in the next image; others are specks."""
        blobs = [] if mask is None else find_blobs(mask)
        sized = (blob for blob in blobs if blob.is_plausible(self.limits))
        return next((blob for blob in sized if not self._is_jump(blob)), None)

    def _is_jump(self, blob: Blob) -> bool:
        return is_jump(self.limits, blob.box, self.box, self.num_missed + 1.0)


class SideBySide(Segmenter):
    """Follows the object with SAM 2 in a thread and with background subtraction in the caller's.

    What is believed has the size of an object and is where one can be since the last image, so neither the
    whole image nor a jump. The mask is SAM 2's where it is believed. The score is the overlap (IoU) of both
    boxes, 0 where there are no two. SAM 2 is told anew, by the other's box, where it alone went wrong for
    some images; from where it went wrong until both agree again, it is not believed alone.
    """

    uses_motion = True

    def __init__(self, sam2: Segmenter, background: Segmenter, longest_wait: float | None = None) -> None:
        """Begin with no object; an image may take so long [s], or as long as SAM 2 takes (None)."""
        self._sam2, self._background, self._longest_wait = sam2, background, longest_wait
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="sam2")
        self._work: Future[Segmentation] | None = None
        self._last: LastPlace | None = None
        self._num_unbelieved, self._is_trusted = 0, True

    def set_limits(self, limits: PlausibilityCfg) -> None:
        """See `Segmenter.set_limits`."""
        super().set_limits(limits)
        self._background.set_limits(limits)

    def start(self, image: Pixels, prompt: BoxPrompt, motion: ImageMotion | None = None) -> Segmentation:
        """See `Segmenter.start`."""
        begin = time.perf_counter()
        self._tell(image, prompt)
        self._last = LastPlace.of(prompt, self.limits)
        self._num_unbelieved, self._is_trusted = 0, True
        other = self._background.start(image, prompt, motion)
        return self._judged(image, self._last, other, begin, is_asked=True)

    def track(self, image: Pixels, motion: ImageMotion | None = None) -> Segmentation:
        """See `Segmenter.track`; where SAM 2 still looks at an earlier image, this one passes it by."""
        begin = time.perf_counter()
        last = self._last
        if last is None:
            return self._background.track(image, motion)
        is_asked = self._is_free()
        if is_asked:
            self._work = self._thread.submit(self._sam2.track, self._kept(image))
        return self._judged(image, last, self._background.track(image, motion), begin, is_asked=is_asked)

    def settle(self) -> None:
        """See `Segmenter.settle`."""
        self._background.settle()

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._cancel()
        self._thread.submit(self._sam2.reset)
        self._background.reset()
        self._last = None

    def _tell(self, image: Pixels, prompt: BoxPrompt) -> None:
        """Have SAM 2 begin anew after what it does now, which nobody waits for any more."""
        self._cancel()
        self._work = self._thread.submit(self._sam2.start, self._kept(image), prompt)

    def _cancel(self) -> None:
        if self._work is not None:
            self._work.cancel()
            self._work = None

    def _is_free(self) -> bool:
        """Whether SAM 2 has nothing to do; without a limit of time, wait until then."""
        if self._work is not None and self._longest_wait is None:
            self._work.exception()
        return self._work is None or self._work.done()

    def _kept(self, image: Pixels) -> Pixels:
        """An image that SAM 2 may look at longer than the caller leaves it as it is."""
        return image if self._longest_wait is None else image.copy()

    def _look(self, begin: float) -> Segmentation | Doubt:
        """What SAM 2 makes of the image that it was asked about, if it does in time."""
        assert self._work is not None
        left = None if self._longest_wait is None else begin + self._longest_wait - time.perf_counter()
        try:
            return self._work.result(left if left is None else max(left, 0.0))
        except TimeoutError:
            return Doubt.LATE
        except RuntimeError:  # of CUDA: no reason to stop looking
            return Doubt.FAILED

    def _judged(
        self, image: Pixels, last: LastPlace, other: Segmentation, begin: float, *, is_asked: bool
    ) -> Segmentation:
        """Decide whom to believe, and go on from there."""
        seen = self._look(begin) if is_asked else Doubt.LATE
        belief = believe(last, seen, other.mask, is_trusted=self._is_trusted)
        self._last = last.after(belief.blob)
        if seen is not Doubt.LATE:
            is_wrong = belief.source is Source.BACKGROUND
            self._num_unbelieved = self._num_unbelieved + 1 if is_wrong else 0
            self._is_trusted &= not is_wrong and belief.doubt is not Doubt.IMPLAUSIBLE
            self._is_trusted |= belief.source is Source.BOTH
        if belief.blob is not None and self._num_unbelieved >= PATIENCE:
            self._tell(image, BoxPrompt(box=belief.blob.box))
            self._num_unbelieved = 0
        return Segmentation(
            mask=None if belief.blob is None else belief.blob.mask(),
            score=belief.overlap,
            source=belief.source or "",
            doubt=belief.doubt or "",
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Belief:
    """What is taken for the object in an image."""

    blob: Blob | None  #: Its pixels; None if it is not found.
    source: Source | None  #: Whose they are.
    doubt: Doubt | None  #: Why they are not of both.
    overlap: float  #: Intersection over union of both boxes, 0 where there are no two.


def believe(
    last: LastPlace, seen: Segmentation | Doubt, other: Mask | None, *, is_trusted: bool = True
) -> Belief:
    """Decide between what SAM 2 saw, or why it saw nothing, and what the background subtraction saw.

    SAM 2 may be trusted: then it can be believed alone, and the mask is its own where both agree.
    """
    motion, look = last.likeliest(other), None
    if isinstance(seen, Segmentation):
        look = last.likeliest(seen.mask)
        doubt = Doubt.LOST if seen.mask is None else Doubt.IMPLAUSIBLE
    else:
        doubt = seen
    if look is None:
        return Belief(blob=motion, source=motion and Source.BACKGROUND, doubt=doubt, overlap=0.0)
    if motion is None:
        blob, source = (look, Source.SAM2) if is_trusted else (None, None)
        return Belief(blob=blob, source=source, doubt=Doubt.ALONE, overlap=0.0)
    overlap = _overlap(look, motion)
    if overlap >= LEAST_AGREEMENT:
        blob = look if is_trusted else motion  # noise agrees once by chance
        return Belief(blob=blob, source=Source.BOTH, doubt=None, overlap=overlap)
    is_look = is_trusted and look.distance(last.expected) <= motion.distance(last.expected)
    blob, source = (look, Source.SAM2) if is_look else (motion, Source.BACKGROUND)
    return Belief(blob=blob, source=source, doubt=Doubt.DISAGREEMENT, overlap=overlap)


def _overlap(blob: Blob, other: Blob) -> float:
    """Intersection over union of two boxes, 0 to 1."""
    (left, top, right, bottom), (x, y, x_end, y_end) = blob.box, other.box
    shared = max(min(right, x_end) - max(left, x), 0.0) * max(min(bottom, y_end) - max(top, y), 0.0)
    return shared / (blob.width * blob.height + other.width * other.height - shared)
