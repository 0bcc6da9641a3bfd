"""The pinhole camera: world points to continuous image coordinates."""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.robot.constants import CameraSpec


def project(
    camera: CameraSpec, points: Float[Tensor, "num_envs num_points 3"]
) -> tuple[Float[Tensor, "num_envs num_points 2"], Float[Tensor, "num_envs num_points"]]:
    """Project world points into the image.

    u = fx x / z + cx and v = fy y / z + cy, with (x, y, z) the point in the camera's frame.

    Args:
        camera: The camera.
        points: Positions in the world frame [m].

    Returns:
        Pixels (u, v) [px], not clipped to the image, and depths z along the optical axis [m]. Where the depth
        is not positive the pixel means nothing.
    """
    matrix, center = _projection(camera, points.dtype, points.device)
    # Products and sums, not a matmul: that may round to TF32 on a GPU, an error of a third of a pixel.
    homogeneous = ((points - center).unsqueeze(-2) * matrix).sum(-1)
    depth = homogeneous[..., 2]
    return homogeneous[..., :2] / depth.unsqueeze(-1), depth


def camera_center(camera: CameraSpec, like: Tensor) -> Float[Tensor, "3"]:
    """Return the camera's centre of projection in the world frame [m], with dtype and device of `like`."""
    return _projection(camera, like.dtype, like.device)[1]


@lru_cache(maxsize=16)
def _projection(
    camera: CameraSpec, dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Return K Rᵀ and the camera's position: K Rᵀ (p - position) = (u z, v z, z). Copied to a device once."""
    w, x, y, z = camera.quat
    norm = w * w + x * x + y * y + z * z
    axes = [  # rows: the camera's right, down and forward axes in the world frame
        [1 - 2 * (y * y + z * z) / norm, 2 * (x * y + w * z) / norm, 2 * (x * z - w * y) / norm],
        [2 * (x * y - w * z) / norm, 1 - 2 * (x * x + z * z) / norm, 2 * (y * z + w * x) / norm],
        [2 * (x * z + w * y) / norm, 2 * (y * z - w * x) / norm, 1 - 2 * (x * x + y * y) / norm],
    ]
    intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    matrix = torch.tensor(intrinsics, dtype=torch.float64) @ torch.tensor(axes, dtype=torch.float64)
    return matrix.to(device, dtype), torch.tensor(camera.pos, dtype=torch.float64).to(device, dtype)
