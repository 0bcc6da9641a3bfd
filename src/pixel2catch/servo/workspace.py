"""Where the robot may be: above the table, and with the hand in a box; by forward kinematics of the arm.

The arm is made of its capsules, the hand is a box that holds it in every position of the fingers. Base and
shoulder stand on the table; self-collisions are the policy's to avoid, and the arm's own controller watches.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np
from jaxtyping import Bool, Float64

from pixel2catch.robots.geometry import TABLE_CLEARANCE, ArmShape, arm_shape, first_chain
from pixel2catch.robots.spec import Vec3
from pixel2catch.robots.workcell import TABLE, TableSpec, WorkcellSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

ROUNDING = 1e-9
"""Gap that is none [m], and what an axis across two that are parallel may seem to show."""

Corners = Float64[np.ndarray, "rows 3"]


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """What arm and hand keep to, world frame.

    Attributes:
        workcell: The robot, the first of it.
        table: The table; the robot stays above it, wherever it is over it.
        clearance: Distance to keep from its top and from its sides [m].
        lower: Lowest corner of the space for the hand [m].
        upper: Highest corner. Source of both: ours; the shipped policies stay 8 cm or more inside.
    """

    workcell: WorkcellSpec = UR5E_ALLEGRO
    table: TableSpec = TABLE
    clearance: float = TABLE_CLEARANCE
    lower: Vec3 = (0.0, -1.1, 0.35)
    upper: Vec3 = (1.25, 1.1, 1.85)

    def contains(self, arm_pos: Float64[np.ndarray, "rows 6"]) -> Bool[np.ndarray, " rows"]:
        """Whether a robot with these arm positions [rad] is where it may be."""
        frames = self.link_frames(arm_pos)
        middle, lower, upper = self._hand_box(frames[-1])
        is_inside = np.logical_and.reduce((lower >= self.lower) & (upper <= self.upper), axis=-1)
        capsules = frames[self._shape.links] @ self._shape.ends[:, None]
        _, _, top = self._sides
        _, _, top_for_axes = self._sides_for_axes
        if (lower[:, 2] >= top).all() and (capsules[:, :, 2] >= top_for_axes).all():
            return is_inside
        is_clear = self._is_around_clear(lower, upper)
        if not is_clear.all():
            is_clear[~is_clear] = self._is_box_clear(middle[~is_clear], frames[-1][~is_clear, :3, :3])
        return is_inside & is_clear & self._are_clear(capsules[:, :, :3])

    def _is_around_clear(self, lower: Corners, upper: Corners) -> Bool[np.ndarray, " rows"]:
        """Which boxes in world axes are beside the table, or high enough."""
        near, far, top = self._sides
        is_over = (lower[:, :2] < far) & (upper[:, :2] > near)
        return ~is_over.all(axis=-1) | (lower[:, 2] >= top)

    def _is_box_clear(
        self, middle: Corners, rotation: Float64[np.ndarray, "rows 3 3"]
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
        reach = np.abs(axes) @ table_half + np.abs(axes @ rotation) @ self._shape.hand_half
        return np.any(distance > reach + ROUNDING, axis=-1)

    def _are_clear(self, ends: Float64[np.ndarray, "capsules rows 3 2"]) -> Bool[np.ndarray, " rows"]:
        """Where all capsules are beside the table, or high enough in that part of them that is over it."""
        near, far, top = self._sides_for_axes
        start, end = ends.transpose(3, 2, 0, 1)
        way = end - start
        slope = np.where(way == 0.0, 1e-12, way)[:2]
        first, last = (near - start[:2]) / slope, (far - start[:2]) / slope
        enter = np.minimum(first, last).max(axis=0).clip(0.0, None)
        leave = np.maximum(first, last).min(axis=0).clip(None, 1.0)
        lowest = start[2] + np.minimum(enter * way[2], leave * way[2])
        return ((enter > leave) | (lowest >= top[..., 0])).all(axis=0)

    @cached_property
    def _sides(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Corners of the table in the plane and height of its top, with the clearance [m]."""
        center, half = np.array(self.table.center), np.array(self.table.size) / 2.0 + self.clearance
        return center[:2] - half, center[:2] + half, center[2] + self.clearance

    @cached_property
    def _sides_for_axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for the axis of each capsule."""
        near, far, top = self._sides
        radii = self._shape.radii[:, None]
        return near[:, None, None] - radii, far[:, None, None] + radii, top + radii[..., None]

    def link_frames(
        self, arm_pos: Float64[np.ndarray, "rows num_joints"]
    ) -> Float64[np.ndarray, "num_joints rows 4 4"]:
        """World frames at the far ends of the arm's links; the last is the hand's, at the palm."""
        angles = arm_pos.T
        terms = np.empty((*angles.shape, 3))
        terms[..., 0], terms[..., 1], terms[..., 2] = 1.0, np.cos(angles), np.sin(angles)
        links = (terms @ self._terms).reshape(*angles.shape, 4, 4)
        return np.array([*accumulate(links, np.matmul)])

    def _hand_box(self, palm: Float64[np.ndarray, "rows 4 4"]) -> tuple[Corners, Corners, Corners]:
        """Middle of the box about the hand, lower and upper corners of one in world axes about that [m]."""
        rotation = palm[:, :3, :3]
        middle = palm[:, :3, 3] + rotation @ self._shape.hand_center
        half = np.abs(rotation) @ self._shape.hand_half
        return middle, middle - half, middle + half

    @cached_property
    def _shape(self) -> ArmShape:
        return arm_shape(self.workcell, self.workcell.palms[0])

    @cached_property
    def _terms(self) -> Float64[np.ndarray, "num_joints 3 16"]:
        matrices = first_chain(self.workcell).matrices.numpy()
        return matrices.swapaxes(0, 1).reshape(matrices.shape[1], 3, 16)
