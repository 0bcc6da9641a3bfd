"""Where robots may be: above the table, and with each hand in a box; by forward kinematics of the arms.

An arm is made of its capsules, a hand is a box that holds it in every position of the fingers. A hand whose
robot has closer boxes about it keeps away from its own forearm and upper arm. Base and shoulder stand on the
table; whether arms, or fingers, hit each other is the policy's to avoid.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from pixel2catch.robots.geometry import TABLE_CLEARANCE, arm_shape, chain_of
from pixel2catch.robots.spec import Vec3
from pixel2catch.robots.workcell import WorkcellSpec


class Space(NamedTuple):
    """What compiled laws ask of a workspace [m]: joints, capsules and boxes, one arm after the other."""

    columns: Int64[np.ndarray, " watched"]  #: Places in joint order of the joints that carry palms.
    first_joints: Int64[np.ndarray, " arms+1"]  #: Where among them those of each arm begin, and their number.
    first_capsules: Int64[np.ndarray, " arms+1"]  #: Where the capsules of each arm begin, and their number.
    first_boxes: Int64[np.ndarray, " arms+1"]  #: Likewise its hand's closer boxes.
    #: Matrix of each joint: constant, cosine and sine terms; the last row of each is left out.
    terms: Float64[np.ndarray, "watched 3 3 4"]
    links: Int64[np.ndarray, " capsules"]  #: After which joint each is.
    ends: Float64[np.ndarray, "capsules 2 3"]  #: Centres of their ends, in the frame after that joint.
    radii: Float64[np.ndarray, " capsules"]
    is_reached: Bool[np.ndarray, " capsules"]  #: Which the hand can reach.
    hands: Float64[np.ndarray, "arms 2 3"]  #: Middle and half extents of the box about a hand, from the palm.
    boxes: Float64[np.ndarray, "boxes 2 3"]  #: Lower and upper corners of closer ones, from the palm.
    walls: Float64[np.ndarray, "2 3"]  #: Lowest and highest corner of the space for the hands.
    table: Float64[np.ndarray, "2 3"]  #: Corners of what is to be kept clear, from the floor to the top.


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
    def space(self) -> Space:
        """The numbers of it."""
        palms, table = self.workcell.palms, self.workcell.table
        shapes = [arm_shape(self.workcell, palm) for palm in palms]
        chains = [chain_of(self.workcell, palm, dtype=torch.float64).matrices.numpy() for palm in palms]
        first_joints = _first([chain.shape[1] for chain in chains])
        links = [shape.links + first for shape, first in zip(shapes, first_joints, strict=False)]
        center, half = np.array(table.center), np.array(table.size) / 2.0 + self.clearance
        near, far = center[:2] - half, center[:2] + half
        return Space(
            columns=_joined(np.arange(palm.first, palm.stop) for palm in palms),
            first_joints=first_joints,
            first_capsules=_first([len(shape.radii) for shape in shapes]),
            first_boxes=_first([shape.boxes.shape[2] for shape in shapes]),
            terms=_joined(chain.swapaxes(0, 1)[:, :, :3] for chain in chains),
            links=_joined(links),
            ends=_joined(shape.ends[:, :3].transpose(0, 2, 1) for shape in shapes),
            radii=_joined(shape.radii for shape in shapes),
            is_reached=_joined(np.isin(np.arange(len(shape.radii)), shape.reached) for shape in shapes),
            hands=np.array([(shape.hand_center, shape.hand_half) for shape in shapes]),
            boxes=_joined(shape.boxes.transpose(2, 0, 1) for shape in shapes),
            walls=np.array((self.lower, self.upper)),
            table=np.array(((*near, 0.0), (*far, center[2] + self.clearance))),
        )


def _joined(parts: Iterable[np.ndarray]) -> np.ndarray:
    """Arrays one after the other; of one layout, for which alone the tick is compiled."""
    return np.ascontiguousarray(np.concatenate([*parts]))


def _first(numbers: list[int]) -> Int64[np.ndarray, " numbers+1"]:
    """Where each of several parts begins of which the numbers are given, and the number of all."""
    return np.cumsum([0, *numbers])
