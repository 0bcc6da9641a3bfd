"""Bounding boxes (xmin, ymin, xmax, ymax) [px] in continuous image coordinates, one per environment."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.robot.constants import CameraSpec


def box_of_points(
    pixels: Float[Tensor, "num_envs num_points 2"],
    is_visible: Bool[Tensor, "num_envs num_points"],
    camera: CameraSpec,
) -> Float[Tensor, "num_envs 4"]:
    """Return the smallest box around the visible points, clipped to the image.

    Args:
        pixels: Projected points [px], on or off the image.
        is_visible: Which of them count (`visibility.is_in_view`, `visibility.is_unoccluded`).
        camera: The camera, for the size of the image.

    Returns:
        Boxes [px]; (0, 0, 0, 0) where no point is visible.
    """
    counts = is_visible.unsqueeze(-1)
    lower = torch.where(counts, pixels, torch.inf).amin(-2)
    upper = torch.where(counts, pixels, -torch.inf).amax(-2)
    box = clip_box(torch.cat([lower, upper], dim=-1), camera)
    return torch.where(is_visible.any(-1, keepdim=True), box, 0.0)


def box_of_mask(
    mask: Bool[Tensor, "num_envs height width"],
) -> tuple[Float[Tensor, "num_envs 4"], Bool[Tensor, " num_envs"]]:
    """Return the smallest box around the true pixels of each mask, from outer pixel edge to outer pixel edge.

    Returns:
        Boxes [px], (0, 0, 0, 0) for an empty mask; and whether any pixel was true.
    """
    spans = [_span(mask.any(-2)), _span(mask.any(-1))]
    box = torch.stack([spans[0][0], spans[1][0], spans[0][1], spans[1][1]], dim=-1)
    is_seen = mask.flatten(1).any(-1)
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
