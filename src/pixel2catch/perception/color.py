"""The object by its colours: a range that a person gives, or histograms that are learned while it is seen."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.image_track import SPECK, ImageTrack, find_blobs
from pixel2catch.perception.segmenter import NOT_FOUND, Image, Mask, Motion, Prompt, Segmentation, Segmenter

Colors = UInt8[np.ndarray, "_ 3"]  #: Red, green and blue of some pixels.

Histogram = Float32[np.ndarray, " num_colors"]
"""How many pixels have each colour, with older images counting less."""

SHIFT = 4  #: A colour is the upper four bits of each channel: 16 levels. Source: ours.
LEVELS = 256 >> SHIFT
FADE = 0.8  #: Weight of what was learned before, in every image. Source: ours; five images.

LEAST_COUNT = 0.1
"""Pixels of a colour, spread over its neighbours, below which it is not known. Source: ours."""


@dataclass(frozen=True, kw_only=True)
class ColorRange:
    """Colours from a first to a last hue, saturation and value."""

    hue: tuple[float, float]  #: First and last [degrees]: red 0, green 120, blue 240; (340, 20) is reds.
    saturation: tuple[float, float] = (0.4, 1.0)  #: Least and largest share of colour in [0, 1]; grey is 0.
    value: tuple[float, float] = (0.2, 1.0)  #: Smallest and largest brightness in [0, 1].

    def __post_init__(self) -> None:
        """Refuse a range that no colour is in."""
        if not all(0.0 <= bound <= 360.0 for bound in self.hue):
            raise PerceptionError(f"hue is {self.hue}; both ends must be in [0, 360] degrees.")
        for name in ("saturation", "value"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 1.0:
                raise PerceptionError(f"{name} is ({low:g}, {high:g}); it must be ordered and in [0, 1].")

    def mask(self, image: Image) -> Mask:
        """Which pixels have such a colour, without single specks."""
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
        pixels = np.zeros(image.shape[:2], dtype=bool)
        start, end = self.hue
        for first, last in [(start, end)] if start <= end else [(start, 360.0), (0.0, end)]:
            lower = np.array((first / 2, 255 * self.saturation[0], 255 * self.value[0]))
            upper = np.array((last / 2, 255 * self.saturation[1], 255 * self.value[1]))
            pixels |= cv2.inRange(hsv, lower, upper) > 0
        return cv2.morphologyEx(pixels.view(np.uint8), cv2.MORPH_OPEN, SPECK) > 0


class ColorThreshold(Segmenter):
    """Follows the region of the object's colour that is nearest to where the object should be.

    Robust where the object is the only thing of its colour. It needs no background and sees the object in the
    hand, too.
    """

    def __init__(self, colors: ColorRange) -> None:
        """Follow these colours."""
        self._colors = colors
        self._track: ImageTrack | None = None

    def start(self, image: Image, prompt: Prompt, motion: Motion | None = None) -> Segmentation:
        """Begin at the prompt: see `Segmenter.start`."""
        self._track = ImageTrack(center=prompt.center, plausibility=self.plausibility)
        return self.track(image)

    def track(self, image: Image, motion: Motion | None = None) -> Segmentation:
        """See `Segmenter.track`."""
        if self._track is None:
            return NOT_FOUND
        blobs = find_blobs(self._colors.mask(image))
        self._track, segmentation = self._track.advanced(blobs, self._track.next_blob(blobs))
        return segmentation

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._track = None


class Appearance:
    """Two colour histograms: of the object, and of all that it could be confused with.

    They count pixels, so a colour is the object's only where the object has more of it than all the rest: a
    black ball over a black hand is not told by its colour.
    """

    def __init__(self) -> None:
        """Know no colour."""
        self._object = np.zeros(LEVELS**3, dtype=np.float32)
        self._other = np.zeros(LEVELS**3, dtype=np.float32)

    def learn(self, pixels: Colors, others: Colors) -> None:
        """Learn the object's pixels in an image, and others that are surely not the object's."""
        self._object = _faded(self._object, pixels)
        self._other = _faded(self._other, others)

    def compare(self, image: Image) -> tuple[Mask, Mask]:
        """Which pixels have the object's colours rather than others, and which have what nothing else had.

        The former are none if the colours are unknown; the latter may be an unseen side of the object.
        """
        codes, other = _codes(image), _spread(self._other)
        is_likely, is_new = _spread(self._object) > np.maximum(other, LEAST_COUNT), other <= LEAST_COUNT
        return is_likely[codes], is_new[codes]

    @property
    def own_share(self) -> float:
        """Share of the object that has colours of its own."""
        is_own = _spread(self._object) > np.maximum(_spread(self._other), LEAST_COUNT)
        return float(self._object[is_own].sum() / max(self._object.sum(), LEAST_COUNT))


def _codes(colors: UInt8[np.ndarray, "*places 3"]) -> Int[np.ndarray, "*places"]:
    """Index of every colour in a histogram."""
    levels = colors >> SHIFT
    return (levels[..., 0].astype(np.intp) * LEVELS + levels[..., 1]) * LEVELS + levels[..., 2]


def _faded(histogram: Histogram, colors: Colors) -> Histogram:
    counts = np.bincount(_codes(colors), minlength=len(histogram)).astype(np.float32)
    return FADE * histogram + (1.0 - FADE) * counts


def _spread(histogram: Histogram) -> Histogram:
    """The histogram, spread over neighbouring colours: what is lit a little differently is alike."""
    cube = histogram.reshape(LEVELS, LEVELS * LEVELS)
    for _ in range(3):  # one channel at a time; the transposition brings the next to the front
        cube = cv2.blur(np.ascontiguousarray(cube), (1, 3), borderType=cv2.BORDER_CONSTANT)
        cube = cube.reshape(LEVELS, LEVELS, LEVELS).transpose(1, 2, 0).reshape(LEVELS, LEVELS * LEVELS)
    return cube.reshape(-1)
