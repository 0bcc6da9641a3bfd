"""The pinhole camera: world points to continuous image coordinates and back, and visibility of points."""

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor, linalg

from pixel2catch.batches import ImagePoints, PointFlags, Points, PointScalars, Scalars, Vectors
from pixel2catch.devices import constant
from pixel2catch.scene.constants import CameraSpec

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Projection:
    """A camera as tensors: the nominal one, or another one in every environment."""

    matrix: Float[Tensor, "*turns 3 3"]  #: K Rᵀ: (u z, v z, z) = matrix (p - center), p at depth z.
    center: Float[Tensor, "*places 3"]  #: Centre of projection, world frame [m].

    def pixels(self, points: Points) -> tuple[ImagePoints, PointScalars]:
        """Return pixels (u, v) [px] and depths [m] of world points: see `project`."""
        # Products and sums, not a matmul: that may round to TF32 on a GPU, an error of a third of a pixel.
        x, y, z = (points - self.center.unsqueeze(-2)).split(1, dim=-1)
        right, down, forward = self.matrix.unsqueeze(-3).unbind(-1)
        homogeneous = x * right + y * down + z * forward
        depth = homogeneous[..., 2]
        return homogeneous[..., :2] / depth.unsqueeze(-1), depth

    @property
    def inverse(self) -> Float[Tensor, "*turns 3 3"]:
        """Return R K⁻¹, the inverse of the matrix: points at depth 1 on the rays of pixels (u, v, 1)."""
        right, down, forward = self.matrix.unbind(-2)
        columns = (linalg.cross(down, forward), linalg.cross(forward, right), linalg.cross(right, down))
        return torch.stack(columns, dim=-1) / (right * columns[0]).sum(-1)[..., None, None]

    def points(self, pixels: Float[Tensor, "num_envs 2"], depth: Scalars) -> Vectors:
        """Return the world points [m] at pixels [px] and depths [m]: the inverse of `pixels`."""
        homogeneous = torch.cat((pixels, torch.ones_like(depth)[:, None]), dim=-1) * depth[:, None]
        return self.center + (homogeneous.unsqueeze(-2) * self.inverse).sum(-1)

    def moved(self, offset: Vectors) -> "Projection":
        """Return the camera, translated by an offset in the world frame [m]."""
        return replace(self, center=self.center + offset)

    def turned(self, rotation: Vectors) -> "Projection":
        """Return the camera, turned about its centre by a rotation vector in the world frame [rad]."""
        angle = linalg.vector_norm(rotation, dim=-1)[:, None, None]
        turn = rotation[:, None].expand(-1, 3, -1)
        rows = self.matrix.expand_as(turn)
        # Rodrigues' formula; sin(x) / x and (1 - cos x) / x² by sinc, which is exact at 0, too.
        across = linalg.cross(turn, rows) * torch.sinc(angle / torch.pi)
        along = 0.5 * torch.sinc(0.5 * angle / torch.pi).square() * (turn * rows).sum(-1, keepdim=True)
        return replace(self, matrix=torch.cos(angle) * rows + across + along * turn)

    def zoomed(self, factor: Scalars, camera: CameraSpec) -> "Projection":
        """Return the camera with its focal length changed by a factor; the principal point is kept."""
        u, v, depth = self.matrix.unbind(-2)
        scale = factor[:, None]
        u = scale * u + (1.0 - scale) * camera.cx * depth
        v = scale * v + (1.0 - scale) * camera.cy * depth
        return replace(self, matrix=torch.stack((u, v, depth.expand_as(u)), dim=-2))


def project(camera: CameraSpec, points: Points) -> tuple[ImagePoints, PointScalars]:
    """Return pixels [px], not clipped to the image, and depths [m] of world points [m].

    u = fx x / z + cx and v = fy y / z + cy, with (x, y, z) the point in the camera's frame and z the depth. A
    pixel with a depth of 0 or less has no meaning.
    """
    return nominal_projection(camera, points).pixels(points)


def nominal_projection(camera: CameraSpec, like: Tensor) -> Projection:
    """Return the camera as specified, with dtype and device of `like`."""
    matrix = constant(_matrix(camera), like.device, like.dtype)
    return Projection(matrix=matrix, center=constant(camera.pos, like.device, like.dtype))


def is_unoccluded(hit_distance: PointScalars) -> PointFlags:
    """Return whether the line from the camera to each point is free.

    Distances are where the ray from the camera to the point first hits robot or table (`Simulation.ray`), in
    units of the ray: 1 is at the point, negative is a miss. The object itself is ignored: its far side
    projects into its own outline.
    """
    return (hit_distance < 0.0) | (hit_distance >= 1.0)


def is_in_view(camera: CameraSpec, pixels: ImagePoints, depth: PointScalars) -> PointFlags:
    """Return whether each projected point lies in front of the camera and on the image."""
    u, v = pixels.unbind(-1)
    return (depth > 0.0) & (u >= 0.0) & (u <= camera.width) & (v >= 0.0) & (v <= camera.height)


@lru_cache(maxsize=16)
def _matrix(camera: CameraSpec) -> Matrix:
    """K Rᵀ, 3 x 3."""
    w, x, y, z = camera.quat
    norm = w * w + x * x + y * y + z * z
    axes = [  # rows: the camera's right, down and forward axes in the world frame
        [1 - 2 * (y * y + z * z) / norm, 2 * (x * y + w * z) / norm, 2 * (x * z - w * y) / norm],
        [2 * (x * y - w * z) / norm, 1 - 2 * (x * x + z * z) / norm, 2 * (y * z + w * x) / norm],
        [2 * (x * z + w * y) / norm, 2 * (y * z - w * x) / norm, 1 - 2 * (x * x + y * y) / norm],
    ]
    columns = [*zip(*axes, strict=True)]
    return tuple(
        tuple(sum(a * b for a, b in zip(row, each, strict=True)) for each in columns) for row in camera.matrix
    )
