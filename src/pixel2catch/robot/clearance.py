"""How near arm and hand are to the table: what a command may not do, and what it costs in training.

The arm is made of its capsules, the hand is a box that holds it in every position of the fingers. Base and
shoulder stand on the table.
"""

from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pixel2catch.robot.constants import PALM_POS, TABLE, UR5E_DH, Vec3
from pixel2catch.robot.kinematics import link_poses
from pixel2catch.robot.ur5e import LINKS, Capsule

TABLE_CLEARANCE = 0.02
"""Distance to keep from the table's top and from its sides [m]. Source: ours."""

HAND_LOWER: Vec3 = (-0.06, -0.18, -0.11)
HAND_UPPER: Vec3 = (0.15, 0.18, 0.25)
"""Corners of a box about the arm's last link and the hand, left or right, whatever the fingers do [m].

In the hand frame. Source: the model over all joint positions, rounded up.
"""

WATCHED_LINKS = (1, 2, 3, 4)
"""Links of the arm that are watched as capsules: those between the shoulder and the last."""

CAPSULES: tuple[tuple[int, Capsule], ...] = tuple(
    (link, capsule) for link in WATCHED_LINKS for capsule in LINKS[link][1]
)
"""Capsules of the watched links, each with its link."""

HAND_LINK = 5
"""The link whose far end is the palm, in the axes of the hand."""

POINTS_PER_CAPSULE = 5
"""Points of a capsule's axis that training looks at. Source: ours: 9 cm apart on the longest."""


def capsule_ends(link: int, capsule: Capsule) -> Float[np.ndarray, "4 2"]:
    """Centres of both ends of a capsule in the frame at the far end of its link, homogeneous [m]."""
    offset, length, alpha = UR5E_DH[link]
    turn = ((1.0, 0.0, 0.0), (0.0, np.cos(alpha), -np.sin(alpha)), (0.0, np.sin(alpha), np.cos(alpha)))
    points = (np.array((capsule.start, capsule.end)) - (length, 0.0, offset)) @ np.array(turn)
    return np.vstack((points.T, np.ones(2)))


def hand_box() -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Middle of the box about the hand, from the palm, and half of its extents, in the hand's axes [m]."""
    lower, upper = np.array(HAND_LOWER), np.array(HAND_UPPER)
    return (lower + upper) / 2.0 - np.array(PALM_POS), (upper - lower) / 2.0


def depth_in_table(arm_pos: Float[Tensor, "num_envs 6"]) -> Float[Tensor, " num_envs"]:
    """How deep the arm, or the box about the hand, is in the table and the clearance about it [m].

    Looks at points of the capsules' axes and at the corners of the box, so that an edge across the table's
    edge may pass; the servo looks at all of them (`deployment.workspace`).

    Args:
        arm_pos: Positions of the arm's joints [rad].
    """
    looked_at = _points(arm_pos.device, arm_pos.dtype)
    poses = link_poses(arm_pos)[:, looked_at.links, :3]
    place = (poses * looked_at.points[:, None]).sum(dim=-1)
    is_over = ((place[..., :2] - looked_at.middle).abs() < looked_at.reach).all(dim=-1)
    depth = (looked_at.top - place[..., 2]).clamp(min=0.0)
    return torch.where(is_over, depth, 0.0).amax(dim=-1)


class _Points(NamedTuple):
    """Points of the robot and the table around each of them, on a device."""

    links: Int[Tensor, " points"]
    points: Float[Tensor, "points 4"]
    middle: Float[Tensor, " 2"]
    reach: Float[Tensor, "points 2"]
    top: Float[Tensor, " points"]


@cache
def _points(device: torch.device, dtype: torch.dtype) -> _Points:
    links, points, radii = [], [], []
    for link, capsule in CAPSULES:
        start, end = capsule_ends(link, capsule).T
        for share in np.linspace(0.0, 1.0, POINTS_PER_CAPSULE):
            links.append(link)
            points.append(start + share * (end - start))
            radii.append(capsule.radius)
    middle, half = hand_box()
    for signs in product((-1.0, 1.0), repeat=3):
        links.append(HAND_LINK)
        points.append(np.append(middle + half * signs, 1.0))
        radii.append(0.0)
    around = np.array(radii)[:, None] + TABLE_CLEARANCE
    *center, top = TABLE.center

    def to_device(values: object, dtype: torch.dtype = dtype) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=dtype, device=device)

    return _Points(
        links=to_device(links, torch.int64),
        points=to_device(points),
        middle=to_device(center),
        reach=to_device(np.array(TABLE.size) / 2.0 + around),
        top=to_device(top + around[:, 0]),
    )
