"""The object by its motion: what differs from the background, near to where the object should be."""

from math import inf

import cv2
import numpy as np

from pixel2catch.perception.appearance import Appearance
from pixel2catch.perception.blobs import Blob, Blobs, Course, FollowCfg, find_blobs
from pixel2catch.perception.foreground import GAP, SPECK, Foreground, ForegroundCfg
from pixel2catch.perception.segmenter import (
    NOT_FOUND,
    BoxPrompt,
    Image,
    Mask,
    Prompt,
    Segmentation,
    Segmenter,
)

INNER = 0.8
"""Share of the width and height of a prompted box in which the object's colours are learned. Source: ours."""

LARGEST_GROWTH = 2.0
"""How many times larger than by its motion the object may be by its colour. Source: ours."""

THINNING = 2
"""Of what is ignored, every second pixel of every second row is learned."""


class BackgroundSubtraction(Segmenter):
    """Follows the moving region that is nearest to where the object should be; needs no weights.

    The camera must not move. Where motion says nothing, at the robot and while the object is held still, the
    object is told by the colours that it had before (`Appearance`).
    """

    def __init__(self, *, background: ForegroundCfg | None = None, follow: FollowCfg | None = None) -> None:
        """Know neither background nor object.

        Args:
            background: How the background is learned.
            follow: Which of several regions is taken.
        """
        self._foreground = Foreground(background or ForegroundCfg())
        self._follow = follow or FollowCfg()
        self._course: Course | None = None
        self._appearance, self._area = Appearance(), inf

    def start(self, image: Image, prompt: Prompt, ignored: Mask | None = None) -> Segmentation:
        """Begin at the prompt, whose colours are learned if it is a box: see `Segmenter.start`."""
        self._course, self._appearance, self._area = Course(center=prompt.center), Appearance(), inf
        if isinstance(prompt, BoxPrompt):
            inside, around = _prompted(prompt.box, image)
            self._learn(image, inside, around, ignored)
        return self.track(image, ignored)

    def track(self, image: Image, ignored: Mask | None = None) -> Segmentation:
        """See `Segmenter.track`."""
        moving, unknown = self._foreground.step(image, ignored)
        if self._course is None:
            return NOT_FOUND
        found, blob = self._next(moving, self._course)
        if blob is None or (found.mask(blob) & _grown(unknown, SPECK)).any():
            mute = np.ones_like(unknown) if blob is None else unknown
            found, blob = self._next(moving | (self._resembling(image, self._course) & mute), self._course)
            blob = None if blob is None or blob.area > LARGEST_GROWTH * self._area else blob
        else:
            self._area = blob.area
            self._learn(image, found.mask(blob), _grown(found.mask(blob), GAP), ignored)
        self._course, segmentation = self._course.advanced(found, blob)
        return segmentation

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._course = None

    def _next(self, mask: Mask, course: Course) -> tuple[Blobs, Blob | None]:
        """The regions of a mask, with small gaps closed, and the one that continues the course."""
        found = find_blobs(cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_CLOSE, GAP) > 0)
        return found, course.next_blob(found, self._follow)

    def _resembling(self, image: Image, course: Course) -> Mask:
        """Pixels with the object's colours, in reach of where it should be."""
        mask = np.zeros(image.shape[:2], dtype=bool)
        window = _window((course.center, course.expected), course.reach(self._follow), image)
        mask[window] = self._appearance.resembles(image[window])
        return mask

    def _learn(self, image: Image, mask: Mask, maybe: Mask, ignored: Mask | None) -> None:
        """Learn the colours of the object, of what is around all that may be its, and of what is ignored."""
        rows, columns = np.nonzero(mask)
        if not len(rows):
            return
        center = (float(columns.mean()), float(rows.mean()))
        window = _window((center,), self._follow.reach, image)
        others = [image[window][~maybe[window]]]
        if ignored is not None:
            others.append(image[::THINNING, ::THINNING][ignored[::THINNING, ::THINNING]])
        self._appearance.learn(image[rows, columns], np.concatenate(others))


def _window(places: tuple[tuple[float, float], ...], reach: float, image: Image) -> tuple[slice, slice]:
    """Rows and columns within reach of places, or of the points of the image nearest to them [px]."""
    edge = np.array((image.shape[1] - 1, image.shape[0] - 1))
    points = np.clip(np.array(places), 0, edge)
    first = np.maximum(points.min(axis=0) - reach, 0).astype(int)
    last = (points.max(axis=0) + reach).astype(int) + 1
    return slice(first[1], last[1]), slice(first[0], last[0])


def _grown(mask: Mask, shape: np.ndarray) -> Mask:
    """The mask with a rim."""
    return cv2.dilate(mask.view(np.uint8), shape) > 0


def _prompted(box: tuple[float, float, float, float], image: Image) -> tuple[Mask, Mask]:
    """Where the object surely is, the ellipse that fills `INNER` of a box, and where it may be, the box."""
    xmin, ymin, xmax, ymax = box
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    across = (columns + 0.5 - 0.5 * (xmin + xmax)) / max(0.5 * (xmax - xmin), 1.0)
    down = (rows + 0.5 - 0.5 * (ymin + ymax)) / max(0.5 * (ymax - ymin), 1.0)
    inside = across**2 + down**2 <= INNER**2
    return inside, _grown((np.abs(across) <= 1.0) & (np.abs(down) <= 1.0), GAP)
