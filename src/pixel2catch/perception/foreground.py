"""What differs from a learned background, in whatever light: where it moves, and where its edges are."""

from collections import deque
from dataclasses import replace
from enum import StrEnum
from functools import partial
from math import log

import cv2
import numpy as np
from jaxtyping import UInt8

from pixel2catch.perception.image_track import (
    GAP,
    SPECK,
    Blob,
    Window,
    find_blobs,
    grown_window,
    window_of,
)
from pixel2catch.perception.segmenter import BoxPrompt, Image, Mask, Motion, Prompt
from pixel2catch.perception.steadiness import Shift, shift_between, shifted

MEMORY = 100
"""Images that the background is the mean of. Source: ours: 3 s at 30 Hz."""

LEARNING_IMAGES = 30
"""Images that a pixel must have been seen in without the robot before its changes mean anything, where it was
not seen in all; and of something new that stands still, until it is background. Source: ours: 1 s."""

LEAST_DIFFERENCE, DEVIATIONS = 6.0, 4.0
"""Levels by which a pixel differs from the background, and how many times its usual difference, at least.
Source: ours; five standard deviations of noise are 3.8 times the mean of the largest of three channels."""

USUAL_WEIGHT, BUSY_WEIGHT = 0.05, 0.003
"""Weight of a new image in what difference of a pixel is usual, and where it differs.

Source: ours: 20 images, and 10 s, in which a place that never rests gets to say nothing, but not one where
a thing passes."""

DARKEST, BRIGHTEST, LEAST_SAMPLES = 24, 232, 100
"""Levels between which a pixel tells the light's gain, and how many pixels tell it. Source: ours: no
noise, and not saturated with a sixth more."""

LEAST_GAIN = 0.004  #: Change of the light that is left as it is: a level in 255.
FLICKER, FLICKER_IMAGES = 0.01, 10
"""Change of the light between two images, as a share, in the median of so many, that is flicker.

Source: ours: an exposure that adapts or steps changes few images or each by less."""

SMOOTHED = np.ones((3, 3), dtype=np.uint8)  #: Pixels that each smoothed one is the mean of.
SAMPLING = 12  #: Every so many rows and columns tell light and noise of an image.

EDGE = 0.3
"""Share of the difference inside a thing at which its edge is. Source: ours: more than what compression adds
around it, and no more than half, where the edge of a blurred thing is."""
BRIGHT = 80.0  #: Percentile of the differences in a region that is that inside: its rim is less.

RIM, LEAST_PART = 0.125, 0.2
"""Share of a thing's width and height that is its rim at most, and of its area that another thing beside it
has at least. Source: ours: four pixels of thirty; a ball and the hand that throws it."""

INNER = 0.8
"""Share of the width and height of a prompted box in which the object surely is. Source: ours."""

LEAST_MOVING = 0.2
"""Share of a prompted object that differs from the background, below which it was taken for background."""


class Weakness(StrEnum):
    """Why what differs from the background is less sure than usual."""

    FEW_IMAGES = "few images of the room"
    FLICKER = "the light flickers"

    @property
    def remedy(self) -> str:
        """What a person can do."""
        return {
            Weakness.FEW_IMAGES: "let the camera see the room for a second before the object is pointed out",
            Weakness.FLICKER: "expose for a multiple of 10 ms at 50 Hz of mains, of 8.33 ms at 60 Hz",
        }[self]


class Foreground:
    """Which pixels differ from the background, in a stream of images, in whatever light.

    Where pixels are ignored the background is not learned: the robot that waits for a throw is not taken for
    background, and neither is what it uncovers taken for an object.
    """

    def __init__(self) -> None:
        """Know no background."""
        self._mean = np.empty((0, 0, 3), dtype=np.float32)
        self._num_images = 0
        self._later: partial[None] | None = None
        self._kept: Mask | None = None
        self._shift: Shift = (0.0, 0.0)
        self._light: deque[float] = deque(maxlen=FLICKER_IMAGES + 1)

    @property
    def weakness(self) -> Weakness | None:
        """What the last image lacked; None for nothing."""
        if self._num_images < LEARNING_IMAGES:
            return Weakness.FEW_IMAGES
        is_unsteady = len(self._light) > FLICKER_IMAGES and np.median(np.abs(np.diff(self._light))) > FLICKER
        return Weakness.FLICKER if is_unsteady else None

    def step(self, image: Image, ignored: Mask | None) -> Motion:
        """Learn the next image, but for pixels in which motion means nothing; None for no such pixel."""
        self.settle()
        smooth = cv2.blur(image, (3, 3))
        if self._mean.shape != image.shape:
            self._begin(smooth)
        self._num_images += 1
        counted = np.ones_like(self._num_seen)
        if ignored is not None:
            counted[grown(ignored, SMOOTHED)] = 0
        smooth = self._lit(smooth, counted)
        shift = shift_between(smooth, self._background, (counted * self._num_seen).view(bool))
        smooth, self._shift = shifted(smooth, (-shift[0], -shift[1])), (round(shift[0]), round(shift[1]))
        first = counted * (self._num_seen == 0)
        _replace(self._mean, smooth, first)
        _replace(self._background, smooth, first)
        known = counted.view(bool) & (self._num_seen >= min(self._num_images - 1, LEARNING_IMAGES))
        difference = _difference(smooth, self._background)
        noise = DEVIATIONS * float(np.median(difference[::SAMPLING, ::SAMPLING]))
        least = min(round(max(noise, LEAST_DIFFERENCE)), 255)
        differs = (difference > self._tolerance) & (difference > least)
        moving = opened(differs) & known
        self._later = partial(self._learn, smooth, difference, differs & known, counted)
        unknown = ~known if ignored is None else ~known & ((counted > 0) | ignored)
        return Motion(
            image=shifted(smooth, self._shift),
            difference=shifted(difference, self._shift),
            moving=shifted(moving, self._shift),
            unknown=shifted(unknown, self._shift),
            ignored=ignored,
            doubt=self.weakness or "",
        )

    def settle(self) -> None:
        """Learn from the last image, which its motion need not wait for; the next image does so first."""
        later, self._later = self._later, None
        if later:
            later()

    def keep(self, mask: Mask | None) -> None:
        """The object's pixels in the last image, which stay foreground however long it stands still."""
        self._kept = None if mask is None else grown(self._steadied(mask), GAP)

    def reveal(self, motion: Motion, prompt: Prompt) -> Motion:
        """The motion in the last image, unknown where a person's box holds what was background so far."""
        if not isinstance(prompt, BoxPrompt) or prompt.is_guess:
            return motion
        inside, maybe = prompted(prompt.box, motion.image)
        if motion.moving[inside].sum() >= LEAST_MOVING * inside.sum():
            return motion
        self.settle()
        self._num_seen[self._steadied(maybe)] = 0
        return replace(motion, unknown=motion.unknown | maybe, moving=motion.moving & ~maybe)

    def _steadied(self, mask: Mask) -> Mask:
        """A mask of the last image, where the background is."""
        return shifted(mask, (-self._shift[0], -self._shift[1]))

    def _begin(self, image: Image) -> None:
        shape = image.shape[:2]
        self._mean, self._background, self._last = image.astype(np.float32), image.copy(), image
        self._usual, self._tolerance = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.uint8)
        self._num_seen, self._num_still = np.zeros(shape, dtype=np.uint8), np.zeros(shape, dtype=np.uint8)
        self._num_images = 0
        self._light.clear()

    def _lit(self, image: Image, counted: np.ndarray) -> Image:
        """The image in the light of the background."""
        every = slice(None, None, SAMPLING), slice(None, None, SAMPLING)
        now, before = image[every].astype(np.float32), self._mean[every]
        told = (now > DARKEST) & (now < BRIGHTEST) & (before > DARKEST) & (before < BRIGHTEST)
        told &= (counted[every] * self._num_seen[every]).view(bool)[..., None]
        ratios = now[told] / before[told]
        gain = float(np.median(ratios)) if len(ratios) >= LEAST_SAMPLES else 1.0
        self._light.append(log(gain))
        return image if abs(gain - 1.0) < LEAST_GAIN else cv2.convertScaleAbs(image, alpha=1.0 / gain)

    def _learn(self, image: Image, difference: np.ndarray, differs: Mask, counted: np.ndarray) -> None:
        """Learn what does not differ, and what has stood still for long."""
        differs = grown(differs, SPECK)
        free = counted if self._kept is None else counted * ~self._kept
        part, num_still = window_of(differs), np.zeros_like(self._num_still)
        if differs[part].size:
            same = (_difference(image[part], self._last[part]) <= 2 * LEAST_DIFFERENCE) & differs[part]
            num_still[part] = cv2.add(self._num_still[part], same.view(np.uint8)) * same
            _replace(self._mean, image, free * (num_still >= LEARNING_IMAGES))
            busy = free[part] * differs[part]
            cv2.accumulateWeighted(difference[part], self._usual[part], BUSY_WEIGHT, mask=busy)
        self._num_still = num_still
        learned = free * ~differs
        cv2.accumulateWeighted(image, self._mean, 1.0 / min(self._num_images, MEMORY), mask=learned)
        cv2.accumulateWeighted(difference, self._usual, USUAL_WEIGHT, mask=learned)
        cv2.add(self._num_seen, counted * ((free > 0) | (self._num_seen > 0)), self._num_seen)
        self._last = image  # and what the next image is compared with, before it comes
        cv2.convertScaleAbs(self._mean, dst=self._background)
        cv2.convertScaleAbs(self._usual, dst=self._tolerance, alpha=DEVIATIONS)


def sharpened(motion: Motion, window: Window) -> Mask:
    """What moves in a part of the image, each thing up to where it differs much less than inside.

    That is a rim, as wide on either side. What a thing would lose more of on one side, unless it falls apart,
    is nearly as bright as the background: there it loses no more than the widest rim.
    """
    moving, sharp = motion.moving[window], np.zeros_like(motion.moving[window])
    for blob in regions(moving):
        place = grown_window(blob.place, len(GAP) // 2 + 1)
        inside, difference = blob.pixels(place), motion.difference[window][place]
        bright = inside & (difference >= EDGE * _percentile(difference[inside], BRIGHT))
        first, *others = regions(bright, place, moving.shape)
        size = np.array((blob.width, blob.height))
        is_uneven = bool((np.abs(np.subtract(first.center, blob.center)) > 0.5 * RIM * size).any())
        if is_uneven and sum(each.area for each in others) < LEAST_PART * first.area:
            width, height = (2 * np.rint(RIM * size).astype(int) + 1).tolist()
            bright |= cv2.erode(inside.view(np.uint8), np.ones((height, width), np.uint8)) > 0
        sharp[place] |= bright
    return closed(sharp)


def prompted(box: tuple[float, float, float, float], image: Image) -> tuple[Mask, Mask]:
    """Where the object surely is, the ellipse that fills `INNER` of a box, and where it may be, the box."""
    xmin, ymin, xmax, ymax = box
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    across = (columns + 0.5 - 0.5 * (xmin + xmax)) / max(0.5 * (xmax - xmin), 1.0)
    down = (rows + 0.5 - 0.5 * (ymin + ymax)) / max(0.5 * (ymax - ymin), 1.0)
    inside = across**2 + down**2 <= INNER**2
    return inside, grown((np.abs(across) <= 1.0) & (np.abs(down) <= 1.0), GAP)


def regions(mask: Mask, window: Window | None = None, shape: tuple[int, int] | None = None) -> list[Blob]:
    """The regions of a mask, with small gaps closed: see `find_blobs`."""
    return find_blobs(closed(mask), window, shape)


def closed(mask: Mask) -> Mask:
    """The mask without small gaps; only the part is looked at in which there is anything."""
    part, whole = grown_window(window_of(mask), len(GAP) // 2 + 1), np.zeros_like(mask)
    whole[part] = cv2.morphologyEx(mask[part].view(np.uint8), cv2.MORPH_CLOSE, GAP) > 0
    return whole


def _percentile(values: np.ndarray, percent: float) -> float:
    """What `np.percentile` returns, in a tenth of its time for a few hundred values (3 µs for 30)."""
    rank = 0.01 * percent * (len(values) - 1)
    low = int(rank)
    pair = np.partition(values, (low, min(low + 1, len(values) - 1)))[low : low + 2].astype(float)
    return float(pair[0] + (rank - low) * (pair[-1] - pair[0]))


def _replace(image: np.ndarray, other: Image, mask: np.ndarray) -> None:
    """Take some pixels of another image over."""
    if mask.any():
        cv2.copyTo(other.astype(image.dtype), mask, image)


def _difference(image: Image, other: Image) -> UInt8[np.ndarray, "height width"]:
    """How far the pixels of two images are apart, in the worst channel."""
    red, green, blue = cv2.split(cv2.absdiff(image, other))
    return cv2.max(cv2.max(red, green), blue)


def opened(mask: Mask) -> Mask:
    """The mask without specks."""
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, SPECK) > 0


def grown(mask: Mask, shape: np.ndarray) -> Mask:
    """The mask with a rim."""
    return cv2.dilate(mask.view(np.uint8), shape) > 0
