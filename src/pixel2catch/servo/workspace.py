"""Where robots may be: above the table, and with each hand in a box; by forward kinematics of the arms.

An arm is made of its capsules, a hand is a box that holds it in every position of the fingers. A hand whose
robot has closer boxes about it keeps away from its own forearm and upper arm. Base and shoulder stand on the
table; whether arms, or fingers, hit each other is the policy's to avoid.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from pixel2catch.robots.geometry import TABLE_CLEARANCE, ArmShape, arm_shape, chain_of
from pixel2catch.robots.spec import Vec3
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.servo.motion import clipped

HAND_CLEARANCE = 0.01  #: Distance of a hand to keep from its own arm [m]. Source: ours.
HALVINGS = 10  #: Of the part of a capsule where it is nearest to a box. Source: ours.
ROUNDING = 1e-9  #: Gap that is none [m], and what an axis across two that are parallel may seem to show.

Corners = Float64[np.ndarray, "rows 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class WatchedArm:
    """The joints that carry a palm, and the shape of what they carry."""

    columns: slice  #: Its joints among those that `Workspace.contains` is asked about.
    shape: ArmShape
    terms: Float64[np.ndarray, "num_joints 3 16"]  #: Matrix of each joint: constant, cosine and sine terms.

    def link_frames(
        self, arm_pos: Float64[np.ndarray, "rows num_joints"]
    ) -> Float64[np.ndarray, "num_joints rows 4 4"]:
        """World frames at the far ends of the arm's links; the last is the hand's, at the palm."""
        angles = arm_pos.T
        terms = np.empty((*angles.shape, 3))
        terms[..., 0], terms[..., 1], terms[..., 2] = 1.0, np.cos(angles), np.sin(angles)
        links = (terms @ self.terms).reshape(*angles.shape, 4, 4)
        return np.array([*accumulate(links, np.matmul)])

    def hand_box(self, palm: Float64[np.ndarray, "rows 4 4"]) -> tuple[Corners, Corners, Corners]:
        """Middle of the box about the hand, lower and upper corners of one in world axes about that [m]."""
        rotation = palm[:, :3, :3]
        middle = palm[:, :3, 3] + rotation @ self.shape.hand_center
        half = np.abs(rotation) @ self.shape.hand_half
        return middle, middle - half, middle + half

    def is_hand_apart(
        self, palm: Float64[np.ndarray, "rows 4 4"], ends: Float64[np.ndarray, "capsules rows 3 2"]
    ) -> Bool[np.ndarray, " rows"]:
        """Where no capsule of the arm is too near to a box of the hand."""
        num_capsules, num_rows, *_ = ends.shape
        points = ends.transpose(1, 2, 3, 0).reshape(num_rows, 3, 2 * num_capsules)
        local = palm[:, :3, :3].transpose(0, 2, 1) @ (points - palm[:, :3, 3:])
        start, end = local.reshape(num_rows, 3, 2, 1, num_capsules).transpose(2, 1, 3, 4, 0)
        lower, upper = self._grown_boxes
        is_beside = (np.maximum(start, end) < lower) | (np.minimum(start, end) > upper)
        is_apart = np.ones(num_rows, dtype=np.bool_)
        if is_beside.any(axis=0).all():
            return is_apart
        enter, leave = crossed(start, end - start, lower, upper)
        box, capsule, row = (enter <= leave).nonzero()
        shares = enter[box, capsule, row], leave[box, capsule, row]
        start, end = start[:, 0, capsule, row], end[:, 0, capsule, row]
        away = distances(start, end - start, *shares, *self.shape.boxes[:, :, box])
        is_apart[row[away <= self._around[capsule]]] = False
        return is_apart

    @cached_property
    def _around(self) -> Float64[np.ndarray, " capsules"]:
        """Distance of the hand's boxes to keep from the axis of each capsule that they reach [m]."""
        return self.shape.radii[self.shape.reached] + HAND_CLEARANCE

    @cached_property
    def _grown_boxes(self) -> Float64[np.ndarray, "2 3 boxes capsules 1"]:
        """Corners of the hand's boxes, with the radius of each capsule and the clearance about them [m]."""
        lower, upper = self.shape.boxes[..., None]
        return np.stack((lower - self._around, upper + self._around))[..., None]


def crossed(
    start: Float64[np.ndarray, "axes *#places"],
    way: Float64[np.ndarray, "axes *#places"],
    near: Float64[np.ndarray, "axes *#places"],
    far: Float64[np.ndarray, "axes *#places"],
) -> tuple[np.ndarray, np.ndarray]:
    """Shares of straight ways at which they enter and leave a space between two corners; none if reversed."""
    slope = np.where(way == 0.0, 1e-12, way)
    first, last = (near - start) / slope, (far - start) / slope
    enter = np.minimum(first, last).max(axis=0).clip(0.0, None)
    return enter, np.maximum(first, last).min(axis=0).clip(None, 1.0)


def distances(
    start: Float64[np.ndarray, "3 ways"],
    way: Float64[np.ndarray, "3 ways"],
    first: Float64[np.ndarray, " ways"],
    last: Float64[np.ndarray, " ways"],
    lower: Float64[np.ndarray, "3 ways"],
    upper: Float64[np.ndarray, "3 ways"],
) -> Float64[np.ndarray, " ways"]:
    """Distances of straight ways, between two shares of each, from boxes [m]: up to 0.1 % of a way too small.

    The distance from a box is convex along a way: where it is least is found by halving.
    """
    for _ in range(HALVINGS):
        middle = (first + last) / 2.0
        place = start + middle * way
        out = place - clipped(place, lower, upper)
        is_before = (out * way).sum(axis=0) < 0.0
        first, last = np.where(is_before, middle, first), np.where(is_before, last, middle)
    place = start + first * way
    out = place - clipped(place, lower, upper)
    return np.linalg.norm(out, axis=0) - (last - first) * np.linalg.norm(way, axis=0)


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """What arms and hands keep to, world frame. Above the table they stay wherever they are over it."""

    workcell: WorkcellSpec
    clearance: float = TABLE_CLEARANCE  #: Distance to keep from the table's top and from its sides [m].
    #: Lowest and highest corner of the space for the hands [m].
    #: Source: ours; the shipped policies stay 8 cm or more inside.
    lower: Vec3 = (0.0, -1.1, 0.35)
    upper: Vec3 = (1.25, 1.1, 1.85)

    @cached_property
    def joints(self) -> Int64[np.ndarray, " num_watched"]:
        """Columns in joint order of the joints that carry palms."""
        return np.concatenate([np.arange(palm.first, palm.stop) for palm in self.workcell.palms])

    @cached_property
    def arms(self) -> tuple[WatchedArm, ...]:
        """What carries each palm."""
        found, first = [], 0
        for palm in self.workcell.palms:
            matrices = chain_of(self.workcell, palm, dtype=torch.float64).matrices.numpy()
            terms = matrices.swapaxes(0, 1).reshape(matrices.shape[1], 3, 16)
            columns = slice(first, first + len(terms))
            found.append(WatchedArm(columns=columns, shape=arm_shape(self.workcell, palm), terms=terms))
            first = columns.stop
        return tuple(found)

    def contains(self, arm_pos: Float64[np.ndarray, "rows num_watched"]) -> Bool[np.ndarray, " rows"]:
        """Whether robots whose `joints` are here [rad] are where they may be."""
        return np.logical_and.reduce([self._holds(arm, arm_pos[:, arm.columns]) for arm in self.arms])

    def _holds(
        self, arm: WatchedArm, arm_pos: Float64[np.ndarray, "rows num_joints"]
    ) -> Bool[np.ndarray, " rows"]:
        """The same of one arm with its hand."""
        frames = arm.link_frames(arm_pos)
        middle, lower, upper = arm.hand_box(frames[-1])
        least, most = self._corners
        is_inside = np.logical_and.reduce((lower >= least) & (upper <= most), axis=-1)
        capsules = (frames[arm.shape.links] @ arm.shape.ends[:, None])[:, :, :3]
        is_inside &= arm.is_hand_apart(frames[-1], capsules[arm.shape.reached])
        near, far, top = self._sides
        around = arm.shape.radii[:, None]
        if (lower[:, 2] >= top).all() and (capsules[:, :, 2] >= top + around[..., None]).all():
            return is_inside
        is_over = ((lower[:, :2] < far) & (upper[:, :2] > near)).all(axis=-1)
        is_clear = ~is_over | (lower[:, 2] >= top)
        if not is_clear.all():
            is_clear[~is_clear] = self._is_box_clear(arm, middle[~is_clear], frames[-1][~is_clear, :3, :3])
        return is_inside & is_clear & self._are_clear(capsules, around)

    def _is_box_clear(
        self, arm: WatchedArm, middle: Corners, rotation: Float64[np.ndarray, "rows 3 3"]
    ) -> Bool[np.ndarray, " rows"]:
        """Which boxes about the hand, in its own axes, do not reach into the space from the floor to the top.

        Two boxes are apart if and only if an axis of one of them, or one across two of them, tells them
        apart. Source: Gottschalk, Lin and Manocha 1996, OBBTree, the separating axis theorem.
        """
        near, far, top = self._sides
        table_middle = np.array((*(near + far) / 2.0, top / 2.0))
        table_half = np.array((*(far - near) / 2.0, top / 2.0))
        own = rotation.transpose(0, 2, 1)
        world = np.broadcast_to(np.eye(3), own.shape)
        across = np.cross(world[:, :, None], own[:, None]).reshape(-1, 9, 3)
        axes = np.concatenate((world, own, across), axis=1)
        distance = np.abs(axes @ (middle - table_middle)[:, :, None])[..., 0]
        reach = np.abs(axes) @ table_half + np.abs(axes @ rotation) @ arm.shape.hand_half
        return np.any(distance > reach + ROUNDING, axis=-1)

    def _are_clear(
        self, ends: Float64[np.ndarray, "capsules rows 3 2"], radii: Float64[np.ndarray, "capsules 1"]
    ) -> Bool[np.ndarray, " rows"]:
        """Where all capsules are beside the table, or high enough in that part of them that is over it."""
        near, far, top = self._sides
        near, far = near[:, None, None] - radii, far[:, None, None] + radii
        start, end = ends.transpose(3, 2, 0, 1)
        way = end - start
        enter, leave = crossed(start[:2], way[:2], near, far)
        lowest = start[2] + np.minimum(enter * way[2], leave * way[2])
        return ((enter > leave) | (lowest >= top + radii)).all(axis=0)

    @cached_property
    def _corners(self) -> Float64[np.ndarray, "2 3"]:
        """Lowest and highest corner of the space for the hands [m]."""
        return np.array((self.lower, self.upper))

    @cached_property
    def _sides(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Corners of the table in the plane and height of its top, with the clearance [m]."""
        table = self.workcell.table
        center, half = np.array(table.center), np.array(table.size) / 2.0 + self.clearance
        return center[:2] - half, center[:2] + half, center[2] + self.clearance
