"""Connected regions of a mask, and the track that says which of them continues the object's motion."""

from dataclasses import dataclass, replace
from math import hypot

import cv2
import numpy as np
from jaxtyping import Int32

from pixel2catch.perception.segmenter import NOT_FOUND, Mask, Segmentation

NUM_NEIGHBORS = 8
"""Pixels that touch at a corner belong together."""

SPECK = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
"""What is smaller than this cross is noise [px]."""

GAP = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
"""Pieces of one thing that are no further apart than this belong together [px]."""

LONGEST_STEP = 20.0
"""How far another thing moves between two images, at most, to be known again [px]. Source: ours."""

LONGEST_COAST = 3
"""Image intervals that an unseen object is taken to go on as before. Source: ours."""


@dataclass(frozen=True, kw_only=True)
class Blob:
    """A connected region of a mask.

    Attributes:
        label: Its number among the regions of the mask.
        area: Number of pixels.
        width: Of its box [px].
        height: Of its box [px].
        center: Middle of its box [px].
    """

    label: int
    area: int
    width: int
    height: int
    center: tuple[float, float]

    def distance(self, point: tuple[float, float]) -> float:
        """From the middle of the box to a point [px]."""
        return hypot(self.center[0] - point[0], self.center[1] - point[1])


@dataclass(frozen=True, kw_only=True)
class Blobs:
    """The connected regions of a mask.

    Attributes:
        shape: Height and width of the mask.
        window: The part of the mask that holds all of them.
        labels: Number of the region that each pixel of this part is in; 0 is none.
        blobs: The regions, largest first.
    """

    shape: tuple[int, int]
    window: tuple[slice, slice]
    labels: Int32[np.ndarray, "rows columns"]
    blobs: tuple[Blob, ...]

    def mask(self, blob: Blob) -> Mask:
        """The pixels of one region."""
        mask = np.zeros(self.shape, dtype=bool)
        mask[self.window] = self.labels == blob.label
        return mask


def find_blobs(mask: Mask) -> Blobs:
    """Return the connected regions of a mask."""
    pixels = mask.view(np.uint8)
    left, top, width, height = cv2.boundingRect(pixels)
    window = slice(top, top + height), slice(left, left + width)
    if not width:
        return Blobs(shape=mask.shape, window=window, labels=np.zeros((0, 0), dtype=np.int32), blobs=())
    _, labels, stats, _ = cv2.connectedComponentsWithStats(pixels[window], connectivity=NUM_NEIGHBORS)
    blobs = [
        Blob(label=label, area=area, width=w, height=h, center=(left + x + 0.5 * w, top + y + 0.5 * h))
        for label, (x, y, w, h, area) in enumerate(stats.tolist())
        if label > 0
    ]
    blobs.sort(key=lambda blob: -blob.area)
    return Blobs(shape=mask.shape, window=window, labels=labels, blobs=tuple(blobs))


def largest_component(mask: Mask) -> Mask:
    """Return the largest connected region of a mask; the mask itself if it has one or none."""
    found = find_blobs(mask)
    return found.mask(found.blobs[0]) if len(found.blobs) > 1 else mask


@dataclass(frozen=True, kw_only=True)
class FollowCfg:
    """Which region continues the object's motion.

    Attributes:
        reach: Largest distance of the object from the way between where it was and where it is expected [px].
            Source: ours; the release of a throw makes up to 30 px in an image interval out of nothing.
        reach_growth: How much further it may be for every image without it [px].
        largest_reach: How far it may be in the end [px].
        least_area: Smallest region that is taken for the object [px].
        largest_side: Longest side of a region that is taken for the object [px]. Source: ours, twice that of
            rendered catches (49 px).
    """

    reach: float = 45.0
    reach_growth: float = 30.0
    largest_reach: float = 150.0
    least_area: int = 6
    largest_side: int = 100


def is_plausible(blob: Blob, cfg: FollowCfg) -> bool:
    """Return whether a region has the size of an object."""
    return blob.area >= cfg.least_area and max(blob.width, blob.height) <= cfg.largest_side


@dataclass(frozen=True, kw_only=True)
class ImageTrack:
    """Where the object was last, and how it moved: constant velocity in the image.

    Attributes:
        center: Middle of its last box [px].
        velocity: Its last change in an image interval [px].
        num_missed: Images since then.
        others: Middles of the things in the last image that were not the object [px].
    """

    center: tuple[float, float]
    velocity: tuple[float, float] = (0.0, 0.0)
    num_missed: int = 0
    others: tuple[tuple[float, float], ...] = ()

    @property
    def expected(self) -> tuple[float, float]:
        """Where it should be in the next image [px]; what stays away for long has stopped somewhere."""
        steps = min(self.num_missed + 1, LONGEST_COAST)
        return self.center[0] + steps * self.velocity[0], self.center[1] + steps * self.velocity[1]

    def missed(self) -> "ImageTrack":
        """The track after an image without the object."""
        return replace(self, num_missed=self.num_missed + 1)

    def seen(self, center: tuple[float, float]) -> "ImageTrack":
        """The track after an image with the object [px]."""
        steps = self.num_missed + 1
        velocity = (center[0] - self.center[0]) / steps, (center[1] - self.center[1]) / steps
        return ImageTrack(center=center, velocity=velocity)

    def advanced(self, found: Blobs, blob: Blob | None) -> tuple["ImageTrack", Segmentation]:
        """The track after the next image, in which the object is this region of those found, and its mask.

        The score is the region's share of its box.
        """
        others = tuple(each.center for each in found.blobs if each is not blob)
        if blob is None:
            return replace(self.missed(), others=others), NOT_FOUND
        score = blob.area / (blob.width * blob.height)
        return replace(self.seen(blob.center), others=others), Segmentation(
            mask=found.mask(blob), score=score
        )

    def reach(self, cfg: FollowCfg) -> float:
        """How far from the way to there it may be [px]."""
        return min(cfg.reach + cfg.reach_growth * self.num_missed, cfg.largest_reach)

    def next_blob(self, found: Blobs, cfg: FollowCfg) -> Blob | None:
        """The region of the right size that is nearest to where the object should be, if any is in reach.

        In reach is what is near to the way from its last place to there: a hand may have stopped it. What was
        another thing in the last image is not the object in this one.
        """
        plausible = (blob for blob in found.blobs if is_plausible(blob, cfg) and not self._is_other(blob))
        near = [blob for blob in plausible if self._distance(blob.center) <= self.reach(cfg)]
        return min(near, key=lambda blob: blob.distance(self.expected), default=None)

    def _distance(self, point: tuple[float, float]) -> float:
        """From a point to the way between the last and the expected place [px]."""
        (u, v), (end_u, end_v) = self.center, self.expected
        du, dv = end_u - u, end_v - v
        length = max(du * du + dv * dv, 1.0)
        share = min(max((du * (point[0] - u) + dv * (point[1] - v)) / length, 0.0), 1.0)
        return hypot(point[0] - u - share * du, point[1] - v - share * dv)

    def _is_other(self, blob: Blob) -> bool:
        """Whether a region continues another thing rather than the object, which is expected elsewhere."""
        away = blob.distance(self.expected)
        (u, v), (end_u, end_v) = blob.center, self.expected
        if abs(u - end_u) <= 0.5 * blob.width and abs(v - end_v) <= 0.5 * blob.height:
            return False
        return any(blob.distance(other) < min(away, LONGEST_STEP) for other in self.others)
