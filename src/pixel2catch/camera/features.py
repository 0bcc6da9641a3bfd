"""Pixel features: what a policy reads of the object's box."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.errors import UnknownNameError
from pixel2catch.scene.constants import CameraSpec

PIXEL_FEATURES = ("cx", "cy", "w", "h", "dcx", "dcy", "dw", "dh")
"""Centre and size of the box as shares of the image, and their changes since the last control step [px]."""


def pixel_features(
    before: Float[Tensor, "num_envs 4"], now: Float[Tensor, "num_envs 4"], camera: CameraSpec
) -> Float[Tensor, "num_envs 8"]:
    """Return every pixel feature of two successive boxes [px], in the order of `PIXEL_FEATURES`.

    z = {cx, cy, w, h, Δcx, Δcy, Δw, Δh}; the paper's method reads all but w and h (`select_features`).

    Source: paper, Eq. 1; release: cx / width and cy / height, differences in pixels; ours: w / width and
    h / height.
    """
    center_now, size_now = _center_and_size(now)
    center_before, size_before = _center_and_size(before)
    return torch.cat(
        [
            _relative_to_image(center_now, camera),
            _relative_to_image(size_now, camera),
            center_now - center_before,
            size_now - size_before,
        ],
        dim=-1,
    )


def select_features(
    features: Float[Tensor, "num_envs 8"], names: Sequence[str]
) -> Float[Tensor, "num_envs num_features"]:
    """Return the named columns of `pixel_features`, in the order of the names.

    Raises:
        UnknownNameError: If a name is not in `PIXEL_FEATURES`.
    """
    for name in names:
        if name not in PIXEL_FEATURES:
            raise UnknownNameError("pixel feature", name, PIXEL_FEATURES)
    columns = [PIXEL_FEATURES.index(name) for name in names]
    return torch.cat([features[:, :0], *(features[:, column : column + 1] for column in columns)], dim=-1)


def _center_and_size(
    box: Float[Tensor, "num_envs 4"],
) -> tuple[Float[Tensor, "num_envs 2"], Float[Tensor, "num_envs 2"]]:
    """Return centre (cx, cy) and size (w, h) of boxes [px]."""
    lower, upper = box[:, :2], box[:, 2:]
    return (lower + upper) / 2, upper - lower


def _relative_to_image(pair: Float[Tensor, "num_envs 2"], camera: CameraSpec) -> Float[Tensor, "num_envs 2"]:
    """Divide (horizontal, vertical) [px] by the width and height of the image."""
    return torch.stack([pair[:, 0] / camera.width, pair[:, 1] / camera.height], dim=-1)
