"""Parts of an image: connected regions of a mask, the size limits of objects, and the robots' pixels."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot

import cv2
import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int, Int32
from scipy.spatial import ConvexHull

from pixel2catch.camera.image import Edges, Mask
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.errors import PerceptionError
from pixel2catch.robots.geometry import bare_model
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene import shapes
from pixel2catch.scene.constants import OBJECT_RADIUS, RGB_CAMERA, CameraSpec

SPECK = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))  #: Smaller regions are noise.
GAP = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))  #: Pieces that are closer belong to one thing.

NEAREST = 0.05  #: Nearer points are left out [m].
MARGIN = 4  #: Margin around the robot [px]. Source: ours, for errors of camera and clocks.
HIDDEN = 0.002  #: A geom that protrudes less from another one of its body is left out [m]. Source: ours.

LARGEST_APPROACH = 3.0  #: Size of an object at its catch over that at its release. Source: ours: 3 m and 1 m.

Window = tuple[slice, slice]  #: Rows and columns of a part of an image.
WHOLE: Window = (slice(0, None), slice(0, None))


@dataclass(frozen=True, kw_only=True)
class PlausibilityCfg:
    """Limits of what can be the object. Source: ours, from 1,500 rendered images of 16 catches.

    A flight of the task moves a box by at most 70 px in a control step, a person's throw by at most 77 px in
    999 of 1,000 steps. An object that the robot hid can reappear with sides up to 33 px longer.
    """

    least_area: int = 6  #: Fewest pixels.
    largest_share: float = 0.02  #: Largest share of the image; 0.005 at most in those images.
    largest_side: float = 100.0  #: Longest side of a region [px]; 49 in those images.
    largest_jump: float = 120.0  #: Of the middle of the box in a control step [px]: 10 m/s, 1.7 m away.
    largest_growth: float = 50.0  #: Of a side of the box in a control step [px].
    largest_sides: int = 1  #: Most sides of the image that the box touches; an object passes one at a time.

    @classmethod
    def up_to(cls, radius: float) -> "PlausibilityCfg":
        """Return the limits for objects up to a ball of this radius [m]."""
        return cls()._scaled(radius / OBJECT_RADIUS)

    def including(self, box: Edges) -> "PlausibilityCfg":
        """Return the limits, raised for an object that fills this box at its release."""
        xmin, ymin, xmax, ymax = box
        return self._scaled(LARGEST_APPROACH * max(xmax - xmin, ymax - ymin) / self.largest_side)

    def is_jump(self, box: Edges, before: Edges, steps: float) -> bool:
        """Return whether a box moved or grew more in these control steps than a thrown object can."""
        xmin, ymin, xmax, ymax = (edge - old for edge, old in zip(box, before, strict=True))
        moved, growth = 0.5 * hypot(xmin + xmax, ymin + ymax), max(xmax - xmin, ymax - ymin)
        return moved > self.largest_jump * max(steps, 1.0) or growth > self.largest_growth * max(steps, 1.0)

    def _scaled(self, scale: float) -> "PlausibilityCfg":
        scale = max(scale, 1.0)
        return replace(
            self,
            largest_share=scale**2 * self.largest_share,
            largest_side=scale * self.largest_side,
            largest_growth=scale * self.largest_growth,
        )


USUAL = PlausibilityCfg()  #: Limits for the paper's objects.


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

    @cached_property
    def box(self) -> Edges:
        """The smallest box around its pixels, outer ones included [px]."""
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

    @cached_property
    def place(self) -> Window:
        """Rows and columns of its box."""
        xmin, ymin, xmax, ymax = map(int, self.box)
        return slice(ymin, ymax), slice(xmin, xmax)

    def mask(self) -> Mask:
        """Return its pixels as a mask of the image."""
        return self.pixels((slice(0, self.shape[0]), slice(0, self.shape[1])))

    def pixels(self, part: Window) -> Mask:
        """Return its pixels as a mask of a part of the image that contains all of it."""
        sizes = [min(each.stop, size) - each.start for each, size in zip(part, self.shape, strict=True)]
        mask = np.zeros(sizes, dtype=bool)
        labels = self.labels[_relative(self.place, self.window)]
        mask[_relative(self.place, part)] = labels == self.label
        return mask

    def meets(self, box: Edges) -> bool:
        """Return whether some of its pixels are in a box [px]."""
        (rows, columns), (top, left) = self.place, (each.start for each in self.window)
        xmin, ymin, xmax, ymax = map(round, box)
        rows = slice(max(rows.start, ymin) - top, max(min(rows.stop, ymax) - top, 0))
        columns = slice(max(columns.start, xmin) - left, max(min(columns.stop, xmax) - left, 0))
        return bool((self.labels[rows, columns] == self.label).any())

    def distance(self, point: tuple[float, float]) -> float:
        """Return the distance from the middle of its box to a point [px]."""
        return hypot(self.center[0] - point[0], self.center[1] - point[1])


def find_blobs(mask: Mask, window: Window = WHOLE, shape: tuple[int, int] | None = None) -> list[Blob]:
    """Return the connected regions of a mask, the largest first.

    The mask is of an image, or of a window of an image with a shape [px].
    """
    whole, window = window, window_of(mask, window)
    part = _relative(window, whole)
    if not mask[part].size:
        return []
    # Pixels that touch at a corner belong to one region; noise can make more regions than 16 bits can number.
    way = 8, cv2.CV_32S, cv2.CCL_SPAGHETTI
    labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(mask[part].view(np.uint8), *way)[1:]
    top, left = (each.start for each in window)
    common = {"labels": labels, "window": window, "shape": shape or mask.shape}
    blobs = []
    for label, (x, y, w, h, area) in enumerate(stats.tolist()[1:], start=1):
        center = (left + x + 0.5 * w, top + y + 0.5 * h)
        blobs.append(Blob(label=label, area=area, width=w, height=h, center=center, **common))
    return sorted(blobs, key=lambda blob: -blob.area)


def regions(mask: Mask, window: Window = WHOLE, shape: tuple[int, int] | None = None) -> list[Blob]:
    """Return the regions of a mask after closing its small gaps: see `find_blobs`."""
    return find_blobs(closed(mask), window, shape)


def window_of(mask: Mask, part: Window = WHOLE) -> Window:
    """Return the smallest window of a mask of an image, or of a part of it; empty for an empty mask."""
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    top, left = y + part[0].start, x + part[1].start
    return slice(top, top + height), slice(left, left + width)


def grown_window(window: Window, rim: float) -> Window:
    """Return a part of an image, enlarged by a rim on each side [px] but not beyond row and column 0."""
    rows, columns = (slice(max(each.start - round(rim), 0), each.stop + round(rim)) for each in window)
    return rows, columns


def closed(mask: Mask) -> Mask:
    """Return the mask with small gaps filled."""
    return grown(mask, GAP, cv2.MORPH_CLOSE)


def opened(mask: Mask) -> Mask:
    """Return the mask without specks."""
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, SPECK).view(bool)


def grown(mask: Mask, shape: np.ndarray, way: int = cv2.MORPH_DILATE) -> Mask:
    """Return the mask, dilated by a structuring element, or changed in another way that grows it."""
    part, whole = grown_window(window_of(mask), len(shape) // 2 + 1), np.zeros_like(mask)
    whole[part] = cv2.morphologyEx(mask[part].view(np.uint8), way, shape).view(bool)
    return whole


def _relative(window: Window, part: Window) -> Window:
    top, left = (each.start for each in part)
    rows, columns = window
    return slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)


class RobotMask:
    """Projects robots into the camera's image. Every geom is convex: its image is the hull of its corners."""

    def __init__(
        self, workcell: WorkcellSpec, camera: CameraSpec = RGB_CAMERA, *, margin: int = MARGIN
    ) -> None:
        """Compute the corners of every geom, visual ones included; the margin is in pixels."""
        self._size, self._margin = (camera.height, camera.width), margin
        self._projection = nominal_projection(camera, torch.zeros(0, dtype=torch.float64))
        self._model = bare_model(workcell, visuals=True)
        self._data = mujoco.MjData(self._model)
        corners = [_corners(self._model, geom) for geom in range(self._model.ngeom)]
        self._geoms, most = _outermost(self._model, corners), max(map(len, corners))
        # All geoms get the same number of corners: the last one is repeated, which does not change the hull.
        padded = [np.pad(each, ((0, most - len(each)), (0, 0)), "edge") for each in corners]
        self._corners = np.stack(padded)[self._geoms]

    def at(self, joint_pos: Float[np.ndarray, " num_joints"]) -> Mask:
        """Return the pixels of the robot at finite joint positions, in joint order [rad]."""
        if not np.isfinite(joint_pos).all():
            raise PerceptionError(f"joint positions must be finite, got {joint_pos}: check the joint states.")
        self._data.qpos[:] = joint_pos
        mujoco.mj_kinematics(self._model, self._data)
        matrix, center = self._projection.matrix.numpy(), self._projection.center.numpy()
        turn = matrix @ self._data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        place = (self._data.geom_xpos[self._geoms] - center) @ matrix.T
        points = self._corners @ turn.swapaxes(1, 2) + place[:, None]
        is_near = points[..., 2] > NEAREST
        # OpenCV fills a pixel if the hull reaches its middle, which is (0, 0) in the first pixel.
        pixels = points[..., :2] / np.where(is_near, points[..., 2], np.inf)[..., None] - 0.5
        rounded = np.rint(np.clip(pixels, -1e4, 1e4)).astype(np.int32)
        canvas, pairs = np.zeros(self._size, dtype=np.uint8), zip(rounded, is_near, strict=True)
        hulls = [cv2.convexHull(corners[seen]) for corners, seen in pairs if seen.any()]
        for hull in hulls:
            cv2.fillConvexPoly(canvas, hull, 1)
        if self._margin:
            cv2.polylines(canvas, hulls, isClosed=True, color=1, thickness=2 * self._margin + 1)
        return canvas.view(bool)


def _outermost(model: mujoco.MjModel, corners: list[np.ndarray]) -> Int[np.ndarray, " num_seen"]:
    """The geoms that protrude from all others of their body by more than `HIDDEN`."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    turns = data.geom_xmat.reshape(-1, 3, 3)
    places = [points @ turn.T + pos for points, turn, pos in zip(corners, turns, data.geom_xpos, strict=True)]
    hulls, body = [ConvexHull(points) for points in places], model.body_weldid[model.geom_bodyid]
    kept: list[int] = []
    for geom in sorted(range(model.ngeom), key=lambda geom: -hulls[geom].volume):
        planes = [hulls[other].equations for other in kept if body[other] == body[geom]]
        reach = [(places[geom] @ plane[:, :3].T + plane[:, 3]).max() for plane in planes]
        if min(reach, default=np.inf) > HIDDEN:
            kept.append(geom)
    return np.array(kept)


def _corners(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "num_corners 3"]:
    """Corners of a convex geom in its own frame [m]."""
    x, y, z = model.geom_size[geom]
    kind, types = mujoco.mjtGeom(model.geom_type[geom]), mujoco.mjtGeom
    makers = {
        types.mjGEOM_BOX: lambda: shapes.box(2 * x, 2 * y, 2 * z),
        types.mjGEOM_CAPSULE: lambda: shapes.capsule(x, 2 * y),
        types.mjGEOM_CYLINDER: lambda: shapes.cylinder(x, 2 * y),
        types.mjGEOM_SPHERE: lambda: shapes.sphere(x),
    }
    if kind not in makers:
        raise PerceptionError(f"the robot has a geom of type {kind.name}, which cannot be projected yet.")
    return makers[kind]().vertices
