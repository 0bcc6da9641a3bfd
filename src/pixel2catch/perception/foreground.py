"""Which pixels differ from a learned background, under changing light and with a shaking camera."""

from collections import deque
from dataclasses import replace
from enum import StrEnum
from functools import partial
from math import log

import cv2
import numpy as np

from pixel2catch.camera.image import Edges, Mask, Pixels
from pixel2catch.perception.regions import GAP, SPECK, Blob, Window, closed, grown, opened, regions, window_of
from pixel2catch.perception.segmenter import BoxPrompt, ImageMotion

MEMORY = 100  #: Images in the mean of the background. Source: ours: 3 s at 30 Hz.

LEARNING_IMAGES = 30
"""Images of a pixel without the robot before it can differ from the background, and images after which a new
thing that stands still becomes background. Source: ours: 1 s."""

LEAST_DIFFERENCE, DEVIATIONS = 6.0, 4.0
"""Smallest difference from the background [levels], and as a multiple of the pixel's usual difference.
Source: ours; five standard deviations of noise are 3.8 times the mean of the largest of three channels."""

LARGEST_NOISE = 2.0 * LEAST_DIFFERENCE  #: Of a still pixel between two images [levels]. Source: ours.

USUAL_WEIGHT, BUSY_WEIGHT = 0.05, 0.003
"""Weight of a new image in the usual difference of a pixel that does not differ, and of one that does.
Source: ours: 20 images, and 10 s: a place that always moves is ignored, one where a thing passes is not."""

LARGEST_TOLERANCE = 130.0  #: Of a place where something often moves [levels]. Source: ours: half of all.

DARKEST, BRIGHTEST, LEAST_SAMPLES = 24, 232, 100
"""Levels of the pixels that measure the gain of the light, and how many are needed. Source: ours: above the
noise, and not saturated with a sixth more light."""

LEAST_GAIN = 0.004  #: Smaller changes of the light are not compensated: one level in 255.

FLICKER, FLICKER_IMAGES = 0.01, 10
"""Relative change of the light between images that is flicker, as the median of 10 images. Source: ours:
an automatic exposure changes few images, or each by less."""

SMOOTHED = np.ones((3, 3), dtype=np.uint8)  #: Pixels that are averaged for each smoothed one.
SAMPLING = 12  #: Distance of the rows and columns that measure light and noise of an image [px].

EDGE, BRIGHT = 0.3, 80.0
"""The edge of a thing has this share of the difference at this percentile of its region. Source: ours: more
than compression adds around it, and less than half, the edge of a blurred thing."""

LEAST_WITH_RIM = 5  #: Width and height from which a thing can have a rim [px]. Source: ours.

CORE = 0.5  #: Depth of a region, as a share of its largest, from which it shows the thing. Source: ours.
RIDGE = 0.3  #: Weight of an even colour there against a linear one. Source: ours; 0.1 to 1 are alike.
LEAST_OPAQUE = 0.45  #: Least share of a thing in its pixels. Source: ours: about half.
LARGEST_LEFT = 12.0  #: Difference from which a mixture does not explain a pixel [levels]. Source: noise.
LIGHT_NOISE = 50.0  #: Norm of a colour from which a shadow is measured [levels]. Source: ours.

LEAST_LOSS, LARGEST_LOSS, COLOR_CHANGE = 0.04, 0.75, 6.0
"""Share of the brightness that a shadow takes from its place, and largest change of a channel that it does
not explain [levels]. Source: ours: a ceiling lights the shadow of a lamp; the least difference."""

INNER = 0.8  #: Share of width and height of a prompted box that the object surely fills. Source: ours.
LEAST_MOVING = 0.2  #: Share of a prompted object that differs, unless it is background. Source: ours.

Shift = tuple[float, float]  #: Of an image, in columns and rows [px].

LARGEST_SHIFT = 4  #: Along columns and rows [px]. Source: ours: twice that of a bad stand.
SPACING = 10  #: Distance of the rows and columns that measure the shift [px]. Source: ours.
NUM_ROUNDS = 5  #: Iterations of the shift, because brightness is linear for a pixel or two only.
LEAST_SLOPE = 3.0  #: Of the brightness at a pixel that measures it [levels/px]. Source: ours: 4 times noise.
LEAST_STEEP = 50  #: Fewest such pixels. Source: ours.
LARGEST_RESIDUAL = 2.5  #: Largest difference of a background pixel, in medians. Source: ours.
LEAST_SHIFT = 0.05  #: Smaller shifts are not compensated [px]. Source: ours: five times the error.
EXPLAINED = 0.7  #: Largest share of the median difference that a shift leaves. Source: ours.


class Weakness(StrEnum):
    """Why the motion in an image is less reliable than usual."""

    FEW_IMAGES = "few images of the room"
    FLICKER = "the light flickers"


REMEDIES = {
    Weakness.FEW_IMAGES: "let the camera see the room for a second before the object is pointed out",
    Weakness.FLICKER: "expose for a multiple of 10 ms at 50 Hz of mains, of 8.33 ms at 60 Hz",
}


class Foreground:
    """Finds the pixels that differ from the background in a stream of images.

    Ignored pixels are not learned: a waiting robot does not become background.
    """

    def __init__(self) -> None:
        self._mean = np.empty((0, 0, 3), dtype=np.float32)
        self._later: partial[None] | None = None
        self._kept: Mask | None = None

    @property
    def weakness(self) -> Weakness | None:
        """Why the last image is less reliable than usual; None without a reason."""
        if self._num_images < LEARNING_IMAGES:
            return Weakness.FEW_IMAGES
        steps = np.abs(np.diff(self._light)) if len(self._light) > FLICKER_IMAGES else np.zeros(1)
        return Weakness.FLICKER if _percentile(steps, 50.0) > FLICKER else None

    def step(self, image: Pixels, ignored: Mask | None) -> ImageMotion:
        """Return the motion in the next image; the motion of ignored pixels has no meaning."""
        self.settle()
        smooth = cv2.blur(image, (3, 3))
        if self._mean.shape != image.shape:
            self._begin(smooth)
        self._num_images += 1
        counted = np.ones_like(self._num_seen)
        if ignored is not None:
            counted[grown(ignored, SMOOTHED)] = 0
        smooth = self._with_background_light(smooth, counted)
        shift = shift_between(smooth, self._background, (counted * self._num_seen).view(bool))
        smooth, self._shift = shifted(smooth, (-shift[0], -shift[1])), (round(shift[0]), round(shift[1]))
        first = counted * (self._num_seen == 0)
        for learned in (self._mean, self._background) if first.any() else ():
            _replace(learned, smooth, first)
        known = counted.view(bool) & (self._num_seen >= min(self._num_images - 1, LEARNING_IMAGES))
        difference = largest_difference(smooth, self._background)
        noise = DEVIATIONS * _percentile(difference[::SAMPLING, ::SAMPLING].ravel(), 50.0)
        least = min(round(max(noise, LEAST_DIFFERENCE)), 255)
        differs = (difference > self._tolerance) & (difference > least)
        moving = opened(differs) & known
        self._later = partial(self._learn, smooth, difference, differs & known, counted)
        unknown = ~known if ignored is None else ~known & ((counted > 0) | ignored)
        arrays = {"image": smooth, "background": self._background, "difference": difference}
        arrays |= {"moving": moving, "unknown": unknown}
        arrays = {name: shifted(each, self._shift) for name, each in arrays.items()}
        return ImageMotion(**arrays, ignored=ignored, doubt=self.weakness or "")

    def settle(self) -> None:
        """Learn from the last image; else the next step does it."""
        later, self._later = self._later, None
        if later:
            later()

    def keep(self, mask: Mask | None) -> None:
        """Set the object's pixels in the last image: they are not learned, however long it stands still."""
        self._kept = None if mask is None else grown(self._steadied(mask), GAP)

    def reveal(self, motion: ImageMotion, prompt: BoxPrompt) -> ImageMotion:
        """Return the motion in the last image, unknown in a person's box whose object was background."""
        if prompt.is_guess:
            return motion
        inside, maybe = prompted(prompt.box, motion.image)
        if motion.moving[inside].sum() >= LEAST_MOVING * inside.sum():
            return motion
        self.settle()
        self._num_seen[self._steadied(maybe)] = 0
        return replace(motion, unknown=motion.unknown | maybe, moving=motion.moving & ~maybe)

    def _steadied(self, mask: Mask) -> Mask:
        """A mask of the last image in the coordinates of the background."""
        return shifted(mask, (-self._shift[0], -self._shift[1]))

    def _begin(self, image: Pixels) -> None:
        shape = image.shape[:2]
        self._mean, self._background, self._last = image.astype(np.float32), image.copy(), image
        self._usual, self._tolerance = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.uint8)
        self._num_seen, self._num_still = np.zeros(shape, dtype=np.uint8), np.zeros(shape, dtype=np.uint8)
        self._num_images = 0
        self._light = deque[float](maxlen=FLICKER_IMAGES + 1)

    def _with_background_light(self, image: Pixels, counted: np.ndarray) -> Pixels:
        """Return the image, scaled to the brightness of the background; record its relative brightness."""
        every = slice(None, None, SAMPLING), slice(None, None, SAMPLING)
        now, before = image[every].astype(np.float32), self._mean[every]
        usable = (now > DARKEST) & (now < BRIGHTEST) & (before > DARKEST) & (before < BRIGHTEST)
        usable &= (counted[every] * self._num_seen[every]).view(bool)[..., None]
        ratios = now[usable] / before[usable]
        gain = _percentile(ratios, 50.0) if len(ratios) >= LEAST_SAMPLES else 1.0
        self._light.append(log(gain))
        return image if abs(gain - 1.0) < LEAST_GAIN else cv2.convertScaleAbs(image, alpha=1.0 / gain)

    def _learn(self, image: Pixels, difference: np.ndarray, differs: Mask, counted: np.ndarray) -> None:
        """Learn the pixels that do not differ, and those that have stood still for long."""
        differs = grown(differs, SPECK)
        free = counted if self._kept is None else counted * ~self._kept
        part, num_still = window_of(differs), np.zeros_like(self._num_still)
        if differs[part].size:
            same = steady(image[part], self._last[part]) & differs[part]
            num_still[part] = cv2.add(self._num_still[part], same.view(np.uint8)) * same
            _replace(self._mean[part], image[part], free[part] * (num_still[part] >= LEARNING_IMAGES))
            busy = free[part] * differs[part]
            cv2.accumulateWeighted(difference[part], self._usual[part], BUSY_WEIGHT, mask=busy)
        self._num_still = num_still
        learned = free * ~differs
        cv2.accumulateWeighted(image, self._mean, 1.0 / min(self._num_images, MEMORY), mask=learned)
        cv2.accumulateWeighted(difference, self._usual, USUAL_WEIGHT, mask=learned)
        cv2.add(self._num_seen, cv2.min(counted, cv2.max(free, self._num_seen)), self._num_seen)
        self._last = image
        cv2.convertScaleAbs(self._mean, dst=self._background)
        cv2.threshold(self._usual, LARGEST_TOLERANCE / DEVIATIONS, 0.0, cv2.THRESH_TRUNC, dst=self._usual)
        cv2.convertScaleAbs(self._usual, dst=self._tolerance, alpha=DEVIATIONS)


def shaded(motion: ImageMotion, window: Window) -> Mask:
    """Return the moving pixels in a part of the image that can be the background in a shadow.

    Each channel lost the same share of its brightness, or as many levels, or something in between.
    """
    moving = motion.moving[window]
    is_shaded = np.zeros_like(moving)
    places, images = np.flatnonzero(moving), (motion.image[window], motion.background[window])
    pixels = (np.take(each.reshape(-1, 3), places, axis=0) for each in images)
    now, before = (np.ascontiguousarray(each.T, dtype=np.float32) for each in pixels)
    lost, total = before - now, np.maximum(before.sum(axis=0), 1.0)
    share = lost.sum(axis=0) / total
    alike, equal = share * before, share * total / 3.0
    change = lost - np.clip(lost, np.minimum(alike, equal), np.maximum(alike, equal))
    is_darker = (share >= LEAST_LOSS) & (share <= LARGEST_LOSS)
    is_shaded[moving] = is_darker & (np.abs(change).max(axis=0) <= COLOR_CHANGE)
    return is_shaded


def sharpened(motion: ImageMotion, window: Window) -> Mask:
    """Return what moves in a part of the image, without the dim rims of things."""
    sharp = closed(motion.moving[window])
    for blob in regions(sharp):
        if min(blob.width, blob.height) >= LEAST_WITH_RIM:
            inside, difference = blob.pixels(blob.place), motion.difference[window][blob.place]
            sharp[blob.place] &= ~(inside & (difference < EDGE * _percentile(difference[inside], BRIGHT)))
    return closed(sharp)


def opaque(blob: Blob, motion: ImageMotion) -> Mask:
    """Return the pixels of a region without its shadow and the transparent part of its blur.

    A pixel is a mixture: image - background = share * (color - background) - loss * background. The thing's
    colour is linear in place, as fitted where the region is deep. A pixel is left out if the mixture explains
    it with a small share. Source: ours, the matting equation of Smith and Blinn (1996) with a shadow.
    """
    mask, kept = blob.pixels(blob.place), np.zeros_like(motion.moving)
    padded = cv2.copyMakeBorder(mask.view(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1]
    core = depth >= CORE * depth.max()
    rim = mask & ~core
    image, background = motion.image[blob.place], motion.background[blob.place]
    points = np.column_stack((np.argwhere(core), image[core])).astype(np.float32)
    middle, spread = points.mean(axis=0), np.cov(points.T, bias=True)
    ridge = np.diag(RIDGE * spread.diagonal()[:2] + 1e-3)
    slopes = np.linalg.solve(spread[:2, :2] + ridge, spread[:2, 2:]).astype(np.float32)
    before, after = (each[rim].T.astype(np.float32, order="C") for each in (background, image))
    places = (np.argwhere(rim) - middle[:2]).astype(np.float32)
    change, contrast = after - before, middle[2:, None] + slopes.T @ places.T - before
    cross, power = (contrast * before).sum(axis=0), (contrast * contrast).sum(axis=0) + 1.0
    lit, dark = (change * contrast).sum(axis=0), (change * before).sum(axis=0)
    light = (before * before).sum(axis=0) + LIGHT_NOISE**2
    loss = np.maximum((cross * lit - power * dark) / (power * light - cross**2), 0.0)
    share = np.clip((lit + loss * cross) / power, 0.0, 1.0)
    left = np.abs(change - share * contrast + loss * before).max(axis=0)
    mask[rim] = (share >= LEAST_OPAQUE) | (left >= LARGEST_LEFT)
    kept[blob.place] = mask
    return kept


def prompted(box: Edges, image: Pixels) -> tuple[Mask, Mask]:
    """Return where the object of a box surely is, the ellipse in its `INNER` share, and where it may be."""
    xmin, ymin, xmax, ymax = box
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    across = (columns + 0.5 - 0.5 * (xmin + xmax)) / max(0.5 * (xmax - xmin), 1.0)
    down = (rows + 0.5 - 0.5 * (ymin + ymax)) / max(0.5 * (ymax - ymin), 1.0)
    inside = across**2 + down**2 <= INNER**2
    return inside, grown((np.abs(across) <= 1.0) & (np.abs(down) <= 1.0), GAP)


def steady(image: Pixels, before: Pixels) -> Mask:
    """Return the pixels that are the same in two images, but for noise."""
    return largest_difference(image, before) <= LARGEST_NOISE


def largest_difference(image: Pixels, before: Pixels) -> np.ndarray:
    """Return by how much two images differ in the channel in which they differ most [levels]."""
    planes = [np.empty(image.shape[:2], dtype=np.uint8) for _ in range(3)]  # `split` makes slower ones
    red, green, blue = cv2.split(cv2.absdiff(image, before), planes)
    return cv2.max(cv2.max(red, green, dst=red), blue, dst=red)


def shift_between(image: Pixels, before: Pixels, known: Mask) -> Shift:
    """Return by how much an image is shifted from another one; (0, 0) if no shift explains the differences.

    Least squares of the differences of brightness over its slopes, at steep pixels of a grid (Lucas and
    Kanade, 1981) that are known background, without pixels that differ much more than the median.
    """
    rim, (height, width) = LARGEST_SHIFT + 1, known.shape

    def at(du: int, dv: int, image: np.ndarray = before[..., 1]) -> np.ndarray:
        return image[rim + dv : height - rim + dv : SPACING, rim + du : width - rim + du : SPACING]

    slopes = 0.5 * np.stack([at(1, 0).astype(float) - at(-1, 0), at(0, 1).astype(float) - at(0, -1)])
    rows, columns = np.nonzero((np.abs(slopes).max(axis=0) >= LEAST_SLOPE) & at(0, 0, known))
    slopes, rows, columns = slopes[:, rows, columns], rim + SPACING * rows, rim + SPACING * columns
    if len(rows) < LEAST_STEEP:
        return 0.0, 0.0
    there, shift, medians = before[rows, columns, 1].astype(float), np.zeros(2), []
    for _ in range(NUM_ROUNDS):
        du, dv = whole = np.clip(np.rint(shift), -LARGEST_SHIFT, LARGEST_SHIFT).astype(int)
        difference = image[rows + dv, columns + du, 1] - there
        left = np.abs(difference - (whole - shift) @ slopes)
        medians.append(_percentile(left, 50.0))
        fits = left <= LARGEST_RESIDUAL * medians[-1] + 1.0
        used = slopes[:, fits]
        change = whole - shift - np.linalg.solve(used @ used.T + np.eye(2), used @ difference[fits])
        if np.abs(change).max() < LEAST_SHIFT:
            break
        shift = shift + change
    is_explained = medians[-1] <= EXPLAINED * medians[0] and np.abs(shift).max() <= LARGEST_SHIFT
    return (float(shift[0]), float(shift[1])) if is_explained else (0.0, 0.0)


def shifted(image: np.ndarray, shift: Shift) -> np.ndarray:
    """Return an image or a mask, shifted with linear interpolation; its edge is repeated outwards."""
    if not any(shift):
        return image
    rim, (height, width) = LARGEST_SHIFT + 1, image.shape[:2]
    (left, across), (top, down) = (divmod(rim - by, 1.0) for by in shift)
    pixels = cv2.copyMakeBorder(image.view(np.uint8), rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    pixels = pixels[int(top) : int(top) + height + 1, int(left) : int(left) + width + 1]
    pixels = _between(pixels[:, :-1], pixels[:, 1:], across)
    return _between(pixels[:-1], pixels[1:], down).view(image.dtype)


def _between(pixels: np.ndarray, others: np.ndarray, share: float) -> np.ndarray:
    return cv2.addWeighted(pixels, 1.0 - share, others, share, 0.0) if share else np.ascontiguousarray(pixels)


def _percentile(values: np.ndarray, percent: float) -> float:
    """The same as `np.percentile`, but ten times as fast for a few hundred values."""
    rank = 0.01 * percent * (len(values) - 1)
    low = int(rank)
    pair = np.sort(values.astype(np.result_type(values, np.float32)))[low : low + 2].astype(float)
    return float(pair[0] + (rank - low) * (pair[-1] - pair[0]))


def _replace(image: np.ndarray, other: Pixels, mask: np.ndarray) -> None:
    part = window_of(mask.view(bool))
    if mask[part].size:
        cv2.copyTo(other[part].astype(image.dtype), mask[part], image[part])
