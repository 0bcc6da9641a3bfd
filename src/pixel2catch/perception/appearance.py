"""What colours the object has and what is around it: where motion cannot speak, colour can."""

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8

from pixel2catch.perception.segmenter import Image, Mask

Colors = UInt8[np.ndarray, "_ 3"]
"""Red, green and blue of some pixels."""

Histogram = Float32[np.ndarray, " num_colors"]
"""How many pixels have each colour, with older images counting less."""

SHIFT = 4
"""A colour is the upper four bits of each channel: 16 levels. Source: ours."""

LEVELS = 256 >> SHIFT

FADE = 0.8
"""Weight of what was learned before, in every image. Source: ours; five images."""

LEAST_COUNT = 0.1
"""Pixels of a colour, spread over its neighbours, below which it is not known. Source: ours."""


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
        """Learn from an image in which the object is known.

        Args:
            pixels: Colours of the object.
            others: Colours that are surely not the object's.
        """
        self._object = _faded(self._object, pixels)
        self._other = _faded(self._other, others)

    def resembles(self, image: Image) -> Mask:
        """Return which pixels have the object's colours rather than others; none if they are unknown."""
        likely = _spread(self._object) > np.maximum(_spread(self._other), LEAST_COUNT)
        return likely[_codes(cv2.blur(image, (3, 3)))]

    def is_new(self, image: Image) -> Mask:
        """Return which pixels have colours that nothing else had: an unseen side of the object may have."""
        return (_spread(self._other) <= LEAST_COUNT)[_codes(cv2.blur(image, (3, 3)))]


def _codes(colors: UInt8[np.ndarray, "*places 3"]) -> Int[np.ndarray, "*places"]:
    """Index of every colour in a histogram."""
    levels = (colors >> SHIFT).astype(np.intp)
    return (levels[..., 0] * LEVELS + levels[..., 1]) * LEVELS + levels[..., 2]


def _faded(histogram: Histogram, colors: Colors) -> Histogram:
    """The histogram after more pixels."""
    counts = np.bincount(_codes(colors), minlength=len(histogram)).astype(np.float32)
    return FADE * histogram + (1.0 - FADE) * counts


def _spread(histogram: Histogram) -> Histogram:
    """The histogram, spread over neighbouring colours: what is lit a little differently is alike."""
    cube = histogram.reshape(LEVELS, LEVELS * LEVELS)
    for _ in range(3):  # one channel at a time; the transposition brings the next to the front
        cube = cv2.blur(np.ascontiguousarray(cube), (1, 3), borderType=cv2.BORDER_CONSTANT)
        cube = cube.reshape(LEVELS, LEVELS, LEVELS).transpose(1, 2, 0).reshape(LEVELS, LEVELS * LEVELS)
    return cube.reshape(-1)
