"""Bounding boxes (xmin, ymin, xmax, ymax) [px] in continuous image coordinates, one per environment."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.scene.constants import CameraSpec


def box_of_points(
    pixels: Float[Tensor, "num_envs num_points 2"],
    is_visible: Bool[Tensor, "num_envs num_points"],
    camera: CameraSpec,
) -> Float[Tensor, "num_envs 4"]:
    """Return the smallest box around the part of the visible points that is on the image.

    A point below the image moves the lower edge of the box to the image's, but bounds neither left nor right:
    the object may be narrower where the image ends. The same holds for the other sides. A point that is not
    visible is behind the camera or hidden.

    Returns:
        Boxes [px]; (0, 0, 0, 0) where no visible point is on the image.
    """
    u, v = pixels.unbind(-1)
    is_in_columns = is_visible & (u >= 0.0) & (u <= camera.width)
    is_in_rows = is_visible & (v >= 0.0) & (v <= camera.height)
    xmin, xmax = _extent(u, is_in_rows)
    ymin, ymax = _extent(v, is_in_columns)
    box = clip_box(torch.stack([xmin, ymin, xmax, ymax], dim=-1), camera)
    return torch.where((is_in_columns & is_in_rows).any(-1, keepdim=True), box, 0.0)


def _extent(
    values: Float[Tensor, "num_envs num_points"], counts: Bool[Tensor, "num_envs num_points"]
) -> tuple[Float[Tensor, " num_envs"], Float[Tensor, " num_envs"]]:
    """Return the smallest and the largest value that counts."""
    return torch.where(counts, values, torch.inf).amin(-1), torch.where(counts, values, -torch.inf).amax(-1)


def box_of_mask(
    mask: Bool[Tensor, "num_envs height width"],
) -> tuple[Float[Tensor, "num_envs 4"], Bool[Tensor, " num_envs"]]:
    """Return the smallest box around the true pixels of each mask, from outer pixel edge to outer pixel edge.

    Returns:
        Boxes [px], (0, 0, 0, 0) for an empty mask; and whether any pixel was true.
    """
    columns, rows = mask.any(-2), mask.any(-1)
    (xmin, xmax), (ymin, ymax) = _span(columns), _span(rows)
    box = torch.stack([xmin, ymin, xmax, ymax], dim=-1)
    is_seen = rows.any(-1)
    return torch.where(is_seen.unsqueeze(-1), box, 0.0), is_seen


def _span(
    row: Bool[Tensor, "num_envs num_pixels"],
) -> tuple[Float[Tensor, " num_envs"], Float[Tensor, " num_envs"]]:
    """Return the lower edge of the first and the upper edge of the last true pixel of each row [px]."""
    edges = torch.arange(row.shape[-1], device=row.device, dtype=torch.get_default_dtype())
    return torch.where(row, edges, torch.inf).amin(-1), torch.where(row, edges + 1.0, -torch.inf).amax(-1)


def clip_box(box: Float[Tensor, "num_envs 4"], camera: CameraSpec) -> Float[Tensor, "num_envs 4"]:
    """Clip boxes to the image [px]."""
    x = box[:, 0::2].clamp(0.0, float(camera.width))
    y = box[:, 1::2].clamp(0.0, float(camera.height))
    return torch.stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]], dim=-1)


def perturb_box(
    box: Float[Tensor, "num_envs 4"], noise: Float[Tensor, "num_envs 4"], camera: CameraSpec
) -> Float[Tensor, "num_envs 4"]:
    """Move each edge by its own noise [px] and clip to the image; edges that cross are exchanged.

    Source: paper (uniform noise of up to 5 px on each edge); the exchange is ours: a box cut by the image
    edge can be thinner than the noise, and a detector never returns a negative width.
    """
    noisy = box + noise
    lower = torch.minimum(noisy[:, :2], noisy[:, 2:])
    upper = torch.maximum(noisy[:, :2], noisy[:, 2:])
    return clip_box(torch.cat([lower, upper], dim=-1), camera)


def hold_box(
    box: Float[Tensor, "num_envs 4"],
    is_seen: Bool[Tensor, " num_envs"],
    previous: Float[Tensor, "num_envs 4"],
) -> Float[Tensor, "num_envs 4"]:
    """Return the box where the object is seen, else the previous box. Source: release."""
    return torch.where(is_seen.unsqueeze(-1), box, previous)
