"""Connected regions of a mask, the size limits of objects, and small operations on masks."""

from dataclasses import dataclass
from math import hypot
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Int32

from pixel2catch.camera.image import Edges, Mask
from pixel2catch.checks import Share, Within
from pixel2catch.scene.constants import OBJECT_RADIUS

NUM_NEIGHBORS = 8  #: Pixels that touch at a corner belong to one region.

SPECK = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
"""Regions smaller than this cross are noise."""

GAP = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
"""Pieces that are closer to each other than this ellipse belong to one thing."""

Window = tuple[slice, slice]  #: Rows and columns of a part of an image.


Pixels = Annotated[float, Within(1.0, 100_000.0)]  #: Largest length or motion [px].


@dataclass(frozen=True, kw_only=True)
class PlausibilityCfg:
    """Limits of what can be the object. Source: ours, from 1,500 rendered images of 16 catches.

    In the task a flight moves a box by at most 70 px in a control step, and a person's throw by at most 77 px
    in 999 of 1,000 steps. Its sides grow by at most 5 px. An object that the robot hid can reappear with
    sides up to 33 px longer (24 rendered throws).
    """

    least_area: Annotated[int, Within(1, 1_000_000)] = 6  #: Fewest pixels.
    #: Largest share of the image. Source: ours; 0.5 % at most in those images.
    largest_share: Share = 0.02
    #: Longest side of a region [px]. Source: ours; 49 in those images.
    largest_side: Pixels = 100.0
    largest_jump: Pixels = 90.0  #: Of the middle of the box in a control step [px]; 61 in those images.
    largest_growth: Pixels = 50.0  #: Of a side of the box in a control step [px].
    #: Most sides of the image that the box touches; an object passes one at a time.
    largest_sides: Annotated[int, Within(0, 4)] = 1

    @classmethod
    def up_to(cls, radius: float) -> "PlausibilityCfg":
        """Return the limits for objects up to a ball of this radius [m]."""
        usual, scale = cls(), max(radius / OBJECT_RADIUS, 1.0)
        return cls(
            largest_share=scale**2 * usual.largest_share,
            largest_side=scale * usual.largest_side,
            largest_growth=scale * usual.largest_growth,
        )


USUAL = PlausibilityCfg()  #: Limits for the paper's objects.


def is_jump(cfg: PlausibilityCfg, box: Edges, before: Edges, steps: float) -> bool:
    """Return whether a box moved or grew more in these control steps than a thrown object can.

    It may shrink by any factor, because the robot may hide a part of the object.
    """
    xmin, ymin, xmax, ymax = (edge - old for edge, old in zip(box, before, strict=True))
    steps = max(steps, 1.0)
    moved, growth = 0.5 * hypot(xmin + xmax, ymin + ymax), max(xmax - xmin, ymax - ymin)
    return moved > cfg.largest_jump * steps or growth > cfg.largest_growth * steps


@dataclass(frozen=True, kw_only=True, eq=False)
class Blob:
    """A connected region of a mask."""

    area: int  #: Number of pixels.
    width: int  #: Of its box [px].
    height: int  #: Of its box [px].
    center: tuple[float, float]  #: Middle of its box [px].
    label: int  #: Its number in `labels`.
    labels: Int32[np.ndarray, "rows columns"]  #: Number of the region of each pixel in `window`.
    window: Window  #: The part of the image that holds all regions of the mask.
    shape: tuple[int, int]  #: Height and width of the image [px].

    def is_plausible(self, cfg: PlausibilityCfg) -> bool:
        """Return whether it has the size of an object."""
        return self.area >= cfg.least_area and max(self.width, self.height) <= cfg.largest_side

    @property
    def box(self) -> Edges:
        """Its box, as `camera.boxes.box_of_mask` defines it [px]."""
        (u, v), x, y = self.center, 0.5 * self.width, 0.5 * self.height
        return u - x, v - y, u + x, v + y

    @property
    def is_whole(self) -> tuple[bool, bool]:
        """Whether the image contains its full width, and its full height."""
        xmin, ymin, xmax, ymax = self.box
        return xmin > 0.0 and xmax < self.shape[1], ymin > 0.0 and ymax < self.shape[0]

    @property
    def is_cut(self) -> bool:
        """Whether it touches the edge of the image."""
        return not all(self.is_whole)

    @property
    def place(self) -> Window:
        """Rows and columns of its box."""
        xmin, ymin, xmax, ymax = map(int, self.box)
        return slice(ymin, ymax), slice(xmin, xmax)

    def mask(self) -> Mask:
        """Return its pixels as a mask of the image."""
        return self.pixels((slice(0, self.shape[0]), slice(0, self.shape[1])))

    def pixels(self, part: Window) -> Mask:
        """Return its pixels as a mask of a part of the image that contains all of it."""
        ends = [(rows.start, min(rows.stop, length)) for rows, length in zip(part, self.shape, strict=True)]
        mask = np.zeros([stop - start for start, stop in ends], dtype=bool)
        labels = self.labels[_relative(self.place, self.window)]
        mask[_relative(self.place, part)] = labels == self.label
        return mask

    def distance(self, point: tuple[float, float]) -> float:
        """Return the distance from the middle of its box to a point [px]."""
        return hypot(self.center[0] - point[0], self.center[1] - point[1])


def find_blobs(mask: Mask, window: Window | None = None, shape: tuple[int, int] | None = None) -> list[Blob]:
    """Return the connected regions of a mask, the largest first.

    Args:
        mask: Of an image, or of a window of it.
        window: That window; None if the mask is of the whole image.
        shape: Height and width of the image if there is a window [px].
    """
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


def regions(mask: Mask, window: Window | None = None, shape: tuple[int, int] | None = None) -> list[Blob]:
    """Return the regions of a mask after closing its small gaps: see `find_blobs`."""
    return find_blobs(closed(mask), window, shape)


def window_of(mask: Mask) -> Window:
    """Return the smallest part of an image that contains a mask; an empty part for an empty mask."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    return slice(top, top + height), slice(left, left + width)


def grown_window(window: Window, rim: float) -> Window:
    """Return a part of an image, enlarged by a rim on each side [px] but not beyond row and column 0."""
    rows, columns = (slice(max(each.start - round(rim), 0), each.stop + round(rim)) for each in window)
    return rows, columns


def closed(mask: Mask) -> Mask:
    """Return the mask with small gaps filled."""
    part, whole = grown_window(window_of(mask), len(GAP) // 2 + 1), np.zeros_like(mask)
    whole[part] = cv2.morphologyEx(mask[part].view(np.uint8), cv2.MORPH_CLOSE, GAP) > 0
    return whole


def opened(mask: Mask) -> Mask:
    """Return the mask without specks."""
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, SPECK) > 0


def grown(mask: Mask, shape: np.ndarray) -> Mask:
    """Return the mask, dilated by a structuring element."""
    return cv2.dilate(mask.view(np.uint8), shape) > 0


def _relative(window: Window, part: Window, *, sign: int = 1) -> Window:
    """Return a window in the coordinates of a part of the image; with sign -1, the inverse."""
    rows, columns = (
        slice(each.start - sign * whole.start, each.stop - sign * whole.start)
        for each, whole in zip(window, part, strict=True)
    )
    return rows, columns
