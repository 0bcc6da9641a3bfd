"""Bounding boxes (xmin, ymin, xmax, ymax) [px], one per environment."""

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from pixel2catch.batches import Boxes, ImagePoints, PointFlags
from pixel2catch.scene.constants import CameraSpec


def box_of_points(pixels: ImagePoints, is_visible: PointFlags, camera: CameraSpec) -> Boxes:
    """Return the smallest box around the visible points, as far as they are on the image [px].

    A point below the image moves the lower edge of the box to that of the image, but not the left and right
    edges, because the object may be narrower there; so with other sides. Without a visible point on the image
    the box is (0, 0, 0, 0).
    """
    u, v = pixels.unbind(-1)
    is_in_columns = is_visible & (u >= 0.0) & (u <= camera.width)
    is_in_rows = is_visible & (v >= 0.0) & (v <= camera.height)
    xmin, xmax = _extent(u, is_in_rows)
    ymin, ymax = _extent(v, is_in_columns)
    box = clip_box(torch.stack([xmin, ymin, xmax, ymax], dim=-1), camera)
    return torch.where((is_in_columns & is_in_rows).any(-1, keepdim=True), box, 0.0)


def _extent(places: Tensor, counts: Bool[Tensor, "num_envs n"]) -> tuple[Tensor, Tensor]:
    return torch.where(counts, places, torch.inf).amin(-1), torch.where(counts, places, -torch.inf).amax(-1)


def center_and_size(box: Shaped[Tensor, "*boxes 4"]) -> tuple[Tensor, Tensor]:
    """Return centres, and widths and heights of boxes [px]."""
    lower, upper = box[..., :2], box[..., 2:]
    return 0.5 * (lower + upper), upper - lower


def clip_box(box: Boxes, camera: CameraSpec) -> Boxes:
    """Clip boxes to the image [px]."""
    x = box[:, 0::2].clamp(0.0, float(camera.width))
    y = box[:, 1::2].clamp(0.0, float(camera.height))
    return torch.stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]], dim=-1)


def perturb_box(box: Boxes, noise: Boxes, camera: CameraSpec) -> Boxes:
    """Move each edge by its own noise [px] and clip to the image; edges that cross are exchanged.

    Source: paper (uniform noise of up to 5 px on each edge); the exchange is ours: a box at the image's edge
    can be thinner than the noise, and a detector returns no negative width.
    """
    noisy = box + noise
    lower = torch.minimum(noisy[:, :2], noisy[:, 2:])
    upper = torch.maximum(noisy[:, :2], noisy[:, 2:])
    return clip_box(torch.cat([lower, upper], dim=-1), camera)
