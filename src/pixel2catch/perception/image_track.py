"""Connected regions of a mask, and the track that says which of them continues the object's motion."""

from dataclasses import dataclass, replace
from math import hypot

import cv2
import numpy as np
from jaxtyping import Int32

from pixel2catch.perception.plausibility import USUAL, PlausibilityCfg
from pixel2catch.perception.segmenter import NOT_FOUND, Mask, Segmentation

NUM_NEIGHBORS = 8
"""Pixels that touch at a corner belong together."""

SPECK = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
"""What is smaller than this cross is noise [px]."""

GAP = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
"""Pieces of one thing that are no further apart than this belong together [px]."""

REACH, REACH_GROWTH, LARGEST_REACH = 45.0, 30.0, 150.0
"""Largest distance of the object from the way between where it was and where it is expected, how much more it
may be for every image without it, and in the end [px]. Source: ours; the release of a throw makes up to 30 px
in an image interval out of nothing."""

FIRST_REACH = 90.0
"""The same while its velocity is unknown [px]. Source: ours: what a box moves at most, `PlausibilityCfg`."""

LARGEST_CHANGE = 12.0
"""Largest change of the motion of what flies, between two images [px]. Source: ours; gravity and approach
make up to 10."""

LONGEST_STEP = 20.0
"""How far another thing moves between two images, at most, to be known again [px]. Source: ours."""

LONGEST_COAST = 3
"""Image intervals that an unseen object is taken to go on as before. Source: ours."""


Window = tuple[slice, slice]  #: Rows and columns of a part of an image, from the first to before the last.


@dataclass(frozen=True, kw_only=True, eq=False)
class Blob:
    """A connected region of a mask.

    Attributes:
        area: Number of pixels.
        width: Of its box [px].
        height: Of its box [px].
        center: Middle of its box [px].
        label: Its number among the regions of the mask.
        labels: Number of the region that each pixel is in, in the part of the image that holds all of them.
        window: That part: rows and columns.
        shape: Height and width of the image.
    """

    area: int
    width: int
    height: int
    center: tuple[float, float]
    label: int
    labels: Int32[np.ndarray, "rows columns"]
    window: Window
    shape: tuple[int, int]

    def is_plausible(self, cfg: PlausibilityCfg) -> bool:
        """Whether it has the size of an object."""
        return self.area >= cfg.least_area and max(self.width, self.height) <= cfg.largest_side

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Its box, as `camera.boxes.box_of_mask` has it [px]."""
        (u, v), x, y = self.center, 0.5 * self.width, 0.5 * self.height
        return u - x, v - y, u + x, v + y

    @property
    def is_whole(self) -> tuple[bool, bool]:
        """Whether all of its width is in the image, and of its height: no end of it touches the edge."""
        xmin, ymin, xmax, ymax = self.box
        return xmin > 0.0 and xmax < self.shape[1], ymin > 0.0 and ymax < self.shape[0]

    @property
    def is_cut(self) -> bool:
        """Whether it touches the edge of the image, beyond which it may go on."""
        return not all(self.is_whole)

    @property
    def place(self) -> Window:
        """Rows and columns of its box."""
        xmin, ymin, xmax, ymax = map(int, self.box)
        return slice(ymin, ymax), slice(xmin, xmax)

    def mask(self) -> Mask:
        """The pixels of the region."""
        return self.pixels((slice(0, self.shape[0]), slice(0, self.shape[1])))

    def pixels(self, part: Window) -> Mask:
        """The pixels of the region in a part of the image that holds all of it."""
        ends = [(rows.start, min(rows.stop, length)) for rows, length in zip(part, self.shape, strict=True)]
        mask = np.zeros([stop - start for start, stop in ends], dtype=bool)
        labels = self.labels[_relative(self.place, self.window)]
        mask[_relative(self.place, part)] = labels == self.label
        return mask

    def distance(self, point: tuple[float, float]) -> float:
        """From the middle of the box to a point [px]."""
        return hypot(self.center[0] - point[0], self.center[1] - point[1])


def find_blobs(mask: Mask, window: Window | None = None, shape: tuple[int, int] | None = None) -> list[Blob]:
    """Return the connected regions of a mask, of an image or a window of one of this shape; largest first."""
    part = window_of(mask)
    if not mask[part].size:
        return []
    pixels = mask[part].view(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(pixels, connectivity=NUM_NEIGHBORS)
    window = part if window is None else _relative(part, window, sign=-1)
    top, left = (each.start for each in window)
    common = {"labels": labels, "window": window, "shape": shape or mask.shape}
    blobs = []
    for label, (x, y, w, h, area) in enumerate(stats.tolist()[1:], start=1):
        center = (left + x + 0.5 * w, top + y + 0.5 * h)
        blobs.append(Blob(label=label, area=area, width=w, height=h, center=center, **common))
    return sorted(blobs, key=lambda blob: -blob.area)


def window_of(mask: Mask) -> Window:
    """The part of an image that holds all of a mask; an empty one if it is empty."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    return slice(top, top + height), slice(left, left + width)


def grown_window(window: Window, rim: float) -> Window:
    """A part of an image with a rim, up to its first row and column [px]."""
    rows, columns = (slice(max(each.start - round(rim), 0), each.stop + round(rim)) for each in window)
    return rows, columns


def _relative(window: Window, part: Window, *, sign: int = 1) -> Window:
    """A window as it is called within a part of the image that begins there; with a sign of -1 back."""
    rows, columns = (
        slice(each.start - sign * whole.start, each.stop - sign * whole.start)
        for each, whole in zip(window, part, strict=True)
    )
    return rows, columns


@dataclass(frozen=True, kw_only=True)
class ImageTrack:
    """Where the object was last, and how it moved: constant velocity in the image.

    Attributes:
        center: Middle of its last box [px].
        velocity: Its last change in an image interval [px].
        num_missed: Images since then.
        num_seen: How often it was seen; its velocity is known from the second time on.
        others: Middles of the things in the last image that were not the object [px].
        plausibility: What can be the object.
    """

    center: tuple[float, float]
    velocity: tuple[float, float] = (0.0, 0.0)
    num_missed: int = 0
    num_seen: int = 0
    others: tuple[tuple[float, float], ...] = ()
    plausibility: PlausibilityCfg = USUAL

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
        return ImageTrack(
            center=center,
            velocity=velocity,
            num_seen=self.num_seen + 1,
            plausibility=self.plausibility,
        )

    def advanced(self, blobs: list[Blob], blob: Blob | None) -> tuple["ImageTrack", Segmentation]:
        """The track after the next image, in which the object is this one of the regions, and its mask.

        The score is the region's share of its box.
        """
        others = tuple(each.center for each in blobs if each is not blob)
        if blob is None:
            return replace(self.missed(), others=others), NOT_FOUND
        score = blob.area / (blob.width * blob.height)
        return replace(self.seen(blob.center), others=others), Segmentation(mask=blob.mask(), score=score)

    @property
    def reach(self) -> float:
        """How far from the way to there it may be [px]."""
        least = REACH if self.num_seen > 1 else FIRST_REACH
        return min(least + REACH_GROWTH * self.num_missed, LARGEST_REACH)

    def next_blob(self, blobs: list[Blob]) -> Blob | None:
        """The likeliest of the regions that may be the object, if there is one: see `candidates`."""
        return next(iter(self.candidates(blobs)), None)

    def candidates(self, blobs: list[Blob]) -> list[Blob]:
        """The regions of the right size that are in reach, the nearest to where the object should be first.

        In reach is what is near to the way from its last place to there: a hand may have stopped it. What was
        another thing in the last image is not the object in this one.
        """
        sized = (blob for blob in blobs if blob.is_plausible(self.plausibility))
        plausible = (blob for blob in sized if not self._is_other(blob, blobs))
        near = (blob for blob in plausible if self._distance(blob.center) <= self.reach)
        return sorted(near, key=lambda blob: blob.distance(self.expected))

    def leads_to(self, blob: Blob) -> bool:
        """Whether a region is where the object should be, up to what gravity and approach change."""
        return self.num_seen > 1 and blob.distance(self.expected) <= LARGEST_CHANGE * (self.num_missed + 1)

    def is_far(self, blob: Blob) -> bool:
        """Whether a region is farther from where the object should be than a release brings it."""
        return blob.distance(self.expected) > REACH

    def _distance(self, point: tuple[float, float]) -> float:
        """From a point to the way between the last and the expected place [px]."""
        (u, v), (end_u, end_v) = self.center, self.expected
        du, dv = end_u - u, end_v - v
        length = max(du * du + dv * dv, 1.0)
        share = min(max((du * (point[0] - u) + dv * (point[1] - v)) / length, 0.0), 1.0)
        return hypot(point[0] - u - share * du, point[1] - v - share * dv)

    def _is_other(self, blob: Blob, blobs: list[Blob]) -> bool:
        """Whether a region continues another thing rather than the object, which is expected elsewhere.

        It does if it is, of all regions, the one that is nearest to where that thing was.
        """
        (u, v), (end_u, end_v) = blob.center, self.expected
        if abs(u - end_u) <= 0.5 * blob.width and abs(v - end_v) <= 0.5 * blob.height:
            return False
        reach = min(blob.distance(self.expected), LONGEST_STEP)
        near = (other for other in self.others if blob.distance(other) < reach)
        return any(all(blob.distance(other) <= each.distance(other) for each in blobs) for other in near)
