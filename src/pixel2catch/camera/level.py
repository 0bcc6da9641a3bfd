"""Boxes and places as a level camera sees them, which makes policies independent of where the camera stands.

The level camera is at the place of the calibrated camera, looks along x and 10° down, and has the lens of the
release. A box of the image is mapped to the box that the level camera would have of the same object.
Source: ours.
"""

from dataclasses import replace
from math import cos, radians, sin

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.batches import Points, Vectors
from pixel2catch.camera.pinhole import Projection, center_and_size, nominal_projection
from pixel2catch.devices import constant
from pixel2catch.scene.constants import FORWARD_TO_OPTICAL, RGB_CAMERA, quat_multiply

TILT = radians(10.0)
"""Angle of the level camera's axis below the horizon [rad]. Source: ours, throws and hand are in view."""

LEVEL_CAMERA = replace(
    RGB_CAMERA,
    pos=(0.0, 0.0, 0.0),
    quat=quat_multiply((cos(TILT / 2.0), 0.0, sin(TILT / 2.0), 0.0), FORWARD_TO_OPTICAL),
)
"""The level camera, at the origin of the world frame."""

LEAST_DEPTH = 0.05
"""Depth to which smaller ones are raised: shares of the other camera's depth, and [m]. Source: ours."""


def level_boxes(box: Float[Tensor, "num_boxes 4"], camera: Projection) -> Float[Tensor, "num_boxes 4"]:
    """Return boxes as the level camera sees them [px], not clipped to an image; empty boxes stay.

    The centre is mapped exactly. The extent is that of the ellipse in the box under the derivative of the
    map at the centre. There is one calibrated camera for all boxes, or one for each.
    """
    level = nominal_projection(LEVEL_CAMERA, box).matrix
    # Products and sums, not a matmul: that may round to TF32 on a GPU.
    turn = (level[:, None] * camera.inverse.transpose(-2, -1).unsqueeze(-3)).sum(-1).expand(len(box), 3, 3)
    center, size = center_and_size(box)
    place = (turn[..., :2] * center[:, None]).sum(-1) + turn[..., 2]
    depth = place[:, 2:].clamp(min=LEAST_DEPTH)
    middle = place[:, :2] / depth
    slope = (turn[:, :2, :2] - middle[..., None] * turn[:, 2:, :2]) / depth[..., None]
    extent = (slope * 0.5 * size[:, None]).square().sum(-1).sqrt()
    is_empty = (size == 0.0).all(-1, keepdim=True)
    return torch.where(is_empty, box, torch.cat((middle - extent, middle + extent), dim=-1))


def level_sight(points: Points, camera_pos: Vectors) -> Points:
    """Return where the level camera at a place sees world points [m].

    That is across and down from its axis, as shares of the depth, and 1 over the depth [1/m].
    """
    found = nominal_projection(LEVEL_CAMERA, points).homogeneous(points - camera_pos[:, None])
    axis, focal = constant(((RGB_CAMERA.cx, RGB_CAMERA.cy), (RGB_CAMERA.fx, RGB_CAMERA.fy)), points.device)
    depth = found[..., 2:].clamp(min=LEAST_DEPTH)
    pixels = found[..., :2] / depth - axis * (found[..., 2:] / depth)
    return torch.cat((pixels / focal, 1.0 / depth), dim=-1)
