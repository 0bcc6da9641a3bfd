"""By how much an image is shifted from another one of the same room: the camera's stand trembles."""

import cv2
import numpy as np

from pixel2catch.perception.segmenter import Image, Mask

Shift = tuple[float, float]  #: In columns and rows [px].

LARGEST_SHIFT = 4  #: Along rows, and along columns [px]. Source: ours: twice a bad stand's.

SPACING = 10  #: Every so many rows and columns tell the shift [px]. Source: ours.

NUM_ROUNDS = 5
"""How often what is left of the shift is looked for, as brightness goes on evenly for a pixel or two."""

LEAST_SLOPE, LEAST_SAMPLES = 3.0, 50
"""Slope of the brightness from which on a pixel tells the shift [levels/px], and how many tell it. Source:
ours: four times the noise."""

LARGEST_RESIDUAL = 2.5
"""How many times the median a pixel's difference is at most if it shows the room. Source: ours."""

LEAST_SHIFT = 0.05  #: Shift that is left as it is [px]. Source: ours: five times its error.

EXPLAINED = 0.7
"""Share of the median difference that a shift leaves at most if it is believed. Source: ours."""


def shift_between(image: Image, before: Image, known: Mask) -> Shift:
    """Return by how much an image is shifted from the one before it.

    Least squares of the differences of brightness over its slopes, at steep pixels of a grid (Lucas and
    Kanade, 1981), without those that differ much more than others, as they show something else.

    Args:
        image: The one that is shifted.
        before: The other one, as large.
        known: Which pixels tell the shift, those of the room.

    Returns:
        The shift; (0, 0) where none is known that explains the differences.
    """
    rim, (height, width) = LARGEST_SHIFT + 1, known.shape

    def at(du: int, dv: int, image: np.ndarray = before[..., 1]) -> np.ndarray:
        return image[rim + dv : height - rim + dv : SPACING, rim + du : width - rim + du : SPACING]

    slopes = 0.5 * np.stack([at(1, 0).astype(float) - at(-1, 0), at(0, 1).astype(float) - at(0, -1)])
    rows, columns = np.nonzero((np.abs(slopes).max(axis=0) >= LEAST_SLOPE) & at(0, 0, known))
    slopes, rows, columns = slopes[:, rows, columns], rim + SPACING * rows, rim + SPACING * columns
    if len(rows) < LEAST_SAMPLES:
        return 0.0, 0.0
    there, shift, medians = before[rows, columns, 1].astype(float), np.zeros(2), []
    for _ in range(NUM_ROUNDS):
        du, dv = whole = np.clip(np.rint(shift), -LARGEST_SHIFT, LARGEST_SHIFT).astype(int)
        difference = image[rows + dv, columns + du, 1] - there
        left = np.abs(difference - (whole - shift) @ slopes)
        medians.append(float(np.median(left)))
        fits = left <= LARGEST_RESIDUAL * medians[-1] + 1.0
        told = slopes[:, fits]
        change = whole - shift - np.linalg.solve(told @ told.T + np.eye(2), told @ difference[fits])
        if np.abs(change).max() < LEAST_SHIFT:
            break
        shift = shift + change
    is_believed = medians[-1] <= EXPLAINED * medians[0] and np.abs(shift).max() <= LARGEST_SHIFT
    return (float(shift[0]), float(shift[1])) if is_believed else (0.0, 0.0)


def shifted(image: np.ndarray, shift: Shift) -> np.ndarray:
    """Return an image, or a mask, shifted, in between linearly; what comes in is what was at its edge."""
    if not any(shift):
        return image
    rim, (height, width) = LARGEST_SHIFT + 1, image.shape[:2]
    (left, across), (top, down) = (divmod(rim - by, 1.0) for by in shift)
    pixels = cv2.copyMakeBorder(image.view(np.uint8), rim, rim, rim, rim, cv2.BORDER_REPLICATE)
    pixels = pixels[int(top) : int(top) + height + 1, int(left) : int(left) + width + 1]
    pixels = _between(pixels[:, :-1], pixels[:, 1:], across)
    return _between(pixels[:-1], pixels[1:], down).view(image.dtype)


def _between(pixels: np.ndarray, others: np.ndarray, share: float) -> np.ndarray:
    """A share of the way from some pixels to others."""
    return cv2.addWeighted(pixels, 1.0 - share, others, share, 0.0) if share else np.ascontiguousarray(pixels)
