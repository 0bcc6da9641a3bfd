"""The object by its motion and its colours: what differs from a learned background where it should be."""

from dataclasses import replace
from functools import partial
from itertools import product
from math import hypot, inf, pi

import cv2
import numpy as np
from jaxtyping import Float

from pixel2catch.perception.color import Appearance
from pixel2catch.perception.foreground import INNER, LEARNING_IMAGES, grown, prompted, regions, sharpened
from pixel2catch.perception.image_track import (
    GAP,
    REACH,
    SPECK,
    Blob,
    ImageTrack,
    Window,
    grown_window,
    window_of,
)
from pixel2catch.perception.segmenter import (
    NOT_FOUND,
    BoxPrompt,
    Image,
    Mask,
    Motion,
    Prompt,
    Segmentation,
    Segmenter,
)

LARGEST_GROWTH, LEAST_SHARE = 2.0, 0.5
"""How many times larger or smaller than before the object may be; where the robot or the image's edge may
hide a part of it, any times smaller. Source: ours."""

LEAST_KNOWN = 0.2
"""Share of a region that has the object's colours if the rest of it is an unseen side. Source: ours."""

LEAST_OWN = 0.5
"""Share of the object that has colours of its own if what moves without them is something else. Source:
ours."""

LARGEST_RATIO = 4.0
"""Largest factor between the area of what was lost and of a flight that is taken for it, either way.
Source: ours: half or twice as far from the camera."""

SIZE_MEMORY = np.array((0.5, 0.5, 0.7))
"""Largest weight of what the object's width, height and area were before, in every image. Source: ours."""

AREA_WEIGHT = 0.6
"""How much a change of the area counts beside one of the sides.

Source: ours; the area is less sure where the object is as bright as what is behind it."""

NEAR = 10.0
"""How far from the object things that stand still have colours that it could be confused with [px].

Source: ours; what is further off and does not move does not touch it."""

THINNING = 2
"""Of what is ignored, every second pixel of every second row is learned."""

LEAST_SPEED, NUM_FRESH = 3.0, LEARNING_IMAGES // 3
"""Speed from which the object moves [px an image], and for how many images after that it is no background
yet, so that what differs in nothing from the background is not the object. Source: ours."""


Size = Float[np.ndarray, "3"]  #: Width, height [px] and area [px²].


class BackgroundSubtraction(Segmenter):
    """Follows what has the object's colours, or moves, near to where the object should be; needs no weights.

    The camera must not move. The colours (`Appearance`) are learned from the prompt and while the object
    flies: they part it from an arm that moves beside it, and show it where motion says nothing, at the
    robot. An object without colours of its own is followed by its motion alone. It never becomes background.
    """

    uses_motion = True

    def __init__(self) -> None:
        """Know no object."""
        self._track: ImageTrack | None = None
        self._appearance, self._num_still = Appearance(), inf
        self._size: Size | None = None
        self._later: partial[None] | None = None

    def start(self, image: Image, prompt: Prompt, motion: Motion | None = None) -> Segmentation:
        """Begin at the prompt, whose colours are learned if it is a box: see `Segmenter.start`.

        What only flies is passed by where it does not resemble what was followed before.
        """
        self.settle()
        guess = prompt.box if isinstance(prompt, BoxPrompt) and prompt.is_guess else None
        if self._track is not None and guess is not None and not self._resembles(image, guess):
            return self.track(image, motion)
        self._track = ImageTrack(center=prompt.center, plausibility=self.plausibility)
        self._appearance = Appearance()
        self._size, self._num_still = None, inf
        return self._follow(motion, prompt)

    def track(self, image: Image, motion: Motion | None = None) -> Segmentation:
        """See `Segmenter.track`."""
        self.settle()
        return self._follow(motion, None)

    def settle(self) -> None:
        """See `Segmenter.settle`: learn the colours."""
        later, self._later = self._later, None
        if later:
            later()

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._track = None

    def _follow(self, motion: Motion | None, prompt: Prompt | None) -> Segmentation:
        """Find the object in the next image, in which it is where a prompt says, if there is one."""
        assert motion is not None
        if self._track is None:
            return replace(NOT_FOUND, doubt=motion.doubt)
        maybe = None
        if isinstance(prompt, BoxPrompt):
            inside, maybe = prompted(prompt.box, motion.image)
            is_cut = any(blob.is_cut for blob in regions(maybe))
            self._size = None if is_cut else _prompted_size(prompt.box)
            self._learn(motion, inside, maybe)
        blobs, blob = self._object(motion, self._track, maybe)
        self._track, segmentation = self._track.advanced(blobs, blob)
        is_moving = blob is not None and prompt is None and hypot(*self._track.velocity) >= LEAST_SPEED
        self._num_still = 0 if is_moving else self._num_still + 1
        if blob is not None and not _touches(blob, motion.unknown):
            mask = blob.mask()
            is_box = maybe is not None and np.array_equal(mask, maybe)  # its area is not the object's
            if not is_box:
                self._resize(blob, self._track.num_seen)
            self._later = partial(self._learn, motion, mask, grown(mask, GAP))
        return replace(segmentation, doubt=motion.doubt)

    def _object(
        self, motion: Motion, track: ImageTrack, within: Mask | None
    ) -> tuple[list[Blob], Blob | None]:
        """The region of the object's colours, else of less, else whatever moves.

        A whole thing that moves, its part with the object's and new colours, or with the object's alone:
        that is taken which continues the size, so that no hand is added and no blurred rim cut off; one that
        is far off, where another thing of this size may move, only if none is near. Looked at is what is in
        reach, or may be in the next image, and is known for another thing then. Where a person's box is all
        that is known, the object may fill little of it, as a cross does.

        Args:
            motion: What moves in the image.
            track: Where the object should be.
            within: Where a person says that it is; None without a prompt.

        Returns:
            The regions that were looked at, and which of them is the object; None if none is.
        """
        window = _window((track.center, track.expected), track.reach + REACH, motion.image)
        alone, whole, alike = self._resembling(motion, window)
        surely = alike & (motion.moving[window] | motion.unknown[window])
        shape = motion.moving.shape
        everywhere = slice(0, shape[0]), slice(0, shape[1])
        choices = ((alone, whole, alike), window), ((surely,), window), ((motion.moving,), everywhere)
        leasts = (LEAST_SHARE, LEAST_KNOWN) if track.num_seen == 1 else (LEAST_SHARE,)
        for least, (masks, place) in product(leasts, choices):
            found = []
            for mask in masks:
                blobs = regions(mask if within is None else mask & within[place], place, shape)
                blob = self._first(track, blobs, motion, least, is_alike=place is window)
                found += [(blobs, blob)] if blob else []
            if found:
                return min(found, key=lambda each: (track.is_far(each[1]), self._change(each[1])))
        blobs = regions(alike, window, shape) if within is None else regions(within)
        return blobs, None if within is None else next(iter(blobs), None)

    def _first(
        self, track: ImageTrack, blobs: list[Blob], motion: Motion, least: float, *, is_alike: bool
    ) -> Blob | None:
        """The likeliest region that fits; where colours of its own are missing, only where it should be."""
        anywhere = is_alike or self._appearance.own_share < LEAST_OWN
        likely = (blob for blob in track.candidates(blobs) if anywhere or track.leads_to(blob))
        return next((blob for blob in likely if self._fits(blob, motion.unknown, least)), None)

    def _change(self, blob: Blob) -> float:
        """How far a region's sides, or its area, whatever is more, are from the object's, as logarithms."""
        if self._size is None:
            return 0.0
        width, height, area = np.abs(np.log(_size(blob) / self._size)).tolist()
        return max(width + height, AREA_WEIGHT * area)

    def _resize(self, blob: Blob, num_seen: int) -> None:
        """Learn the size of the object, seen so often, as a mean in which later images count more.

        What the image's edge cuts is as much larger than before as the side that it leaves whole.
        """
        size, before = _size(blob), self._size
        if before is None:
            self._size = None if blob.is_cut else size
            return
        memory = np.minimum(SIZE_MEMORY, num_seen / (num_seen + 1.0))
        learned = memory * before + (1.0 - memory) * size
        if blob.is_cut:
            growth = np.max((learned / before)[:2], initial=1.0, where=np.array(blob.is_whole))
            learned = before * (growth, growth, growth**2)
        self._size = learned

    @property
    def _is_fresh(self) -> bool:
        """Whether the object moved so lately that it is no background yet."""
        return self._num_still < NUM_FRESH

    def _fits(self, blob: Blob, unknown: Mask, least: float) -> bool:
        """Whether a region has the object's area, or less where robot or image's edge may hide a part."""
        if self._size is None:
            return True
        share = blob.area / float(self._size[2])
        return share <= LARGEST_GROWTH and (share >= least or blob.is_cut or _touches(blob, unknown))

    def _resembling(self, motion: Motion, window: Window) -> tuple[Mask, Mask, Mask]:
        """In a window, things that move and have the object's colours; these with new colours; these alone.

        What differs in nothing from a background that is known is not the object.
        """
        has_colors, is_new = self._appearance.compare(motion.image[window])
        sharp = sharpened(motion, window)
        extended = _extended(has_colors, is_new & motion.moving[window])
        changed = sharp | motion.unknown[window]
        return _extended(has_colors & sharp, sharp), extended & changed, has_colors & changed

    def _resembles(self, image: Image, box: tuple[float, float, float, float]) -> bool:
        """Whether what fills a box has the size of what was followed, and its colours if it has any."""
        inside, _ = prompted(box, image)
        area = float(inside.sum()) / INNER**2
        if self._size is not None and not 1 / LARGEST_RATIO <= area / self._size[2] <= LARGEST_RATIO:
            return False
        has_colors, _ = self._appearance.compare(cv2.blur(image, (3, 3)))
        least = LEAST_KNOWN * self._appearance.own_share
        return bool(has_colors[inside].sum() >= least * inside.sum())

    def _learn(self, motion: Motion, mask: Mask, maybe: Mask) -> None:
        """Learn the colours of the object, and of what it could be confused with.

        That is what is ignored, what else moves, and, unless the object moves, what stands beside it.
        """
        image, ignored = motion.image, motion.ignored
        box = window_of(mask)
        if not mask[box].size:
            return
        far, near = grown_window(box, REACH), grown_window(box, NEAR)
        others = [image[far][motion.moving[far] & ~maybe[far]]]
        if ignored is not None:
            others.append(image[::THINNING, ::THINNING][ignored[::THINNING, ::THINNING]])
        if not self._is_fresh:
            others.append(image[near][~motion.moving[near] & ~maybe[near]])
        self._appearance.learn(image[box][mask[box]], np.concatenate(others))


def _size(blob: Blob) -> Size:
    return np.array((blob.width, blob.height, blob.area), dtype=float)


def _prompted_size(box: tuple[float, float, float, float]) -> Size:
    """The size of an ellipse that fills a box."""
    width, height = max(box[2] - box[0], 1.0), max(box[3] - box[1], 1.0)
    return np.array((width, height, 0.25 * pi * width * height))


def _window(places: tuple[tuple[float, float], ...], reach: float, image: Image) -> Window:
    """Rows and columns within reach of places, or of the points of the image nearest to them [px]."""
    ends = (
        sorted(min(max(place[axis], 0.0), image.shape[1 - axis] - 1.0) for place in places) for axis in (1, 0)
    )
    rows, columns = (slice(max(int(low - reach), 0), int(high + reach) + 1) for low, high in ends)
    return rows, columns


def _touches(blob: Blob, mask: Mask) -> bool:
    """Whether a region touches a mask."""
    place = grown_window(blob.place, 1)
    return bool((grown(blob.pixels(place), SPECK) & mask[place]).any())


def _extended(mask: Mask, more: Mask) -> Mask:
    """A mask with those connected regions of it and of more that are to a good part its own."""
    _, labels = cv2.connectedComponents((mask | more).view(np.uint8))
    own = np.bincount(labels[mask], minlength=labels.max() + 1)
    is_own = own >= LEAST_KNOWN * np.bincount(labels.ravel())
    is_own[0] = False
    return is_own[labels.astype(np.intp)]
