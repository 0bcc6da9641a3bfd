"""The pinhole camera: world points to image coordinates and back, visible points, and boxes about them."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, linalg

from pixel2catch.batches import Boxes, ImagePoints, PointFlags, Points, PointScalars, Scalars, Vectors
from pixel2catch.devices import constant
from pixel2catch.robots.poses import rotation_matrix
from pixel2catch.scene.constants import CameraSpec

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Projection:
    """A camera as tensors: the nominal one, or another one in every environment."""

    matrix: Float[Tensor, "*turns 3 3"]  #: K Rᵀ: (u z, v z, z) = matrix (p - center), p at depth z.
    center: Float[Tensor, "*places 3"]  #: Centre of projection, world frame [m].

    def homogeneous(self, points: Points) -> Points:
        """Return (u z, v z, z) of world points [m] at depth z, with pixels (u, v)."""
        # Products and sums, not a matmul: that may round to TF32 on a GPU, an error of a third of a pixel.
        x, y, z = (points - self.center.unsqueeze(-2)).split(1, dim=-1)
        right, down, forward = self.matrix.unsqueeze(-3).unbind(-1)
        return x * right + y * down + z * forward

    def pixels(self, points: Points) -> tuple[ImagePoints, PointScalars]:
        """Return pixels (u, v) [px] and depths [m] of world points: see `project`."""
        found = self.homogeneous(points)
        return found[..., :2] / found[..., 2:], found[..., 2]

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


def scaled_box(box: Boxes, factor: float) -> Boxes:
    """Return boxes [px], scaled by a factor about their centres."""
    center, size = center_and_size(box)
    half_size = 0.5 * factor * size
    return torch.cat((center - half_size, center + half_size), dim=-1)


def perturb_box(box: Boxes, noise: Boxes, camera: CameraSpec) -> Boxes:
    """Move each edge by its own noise [px] and clip to the image; edges that cross are exchanged.

    Source: paper (uniform noise of up to 5 px on each edge); the exchange is ours: a box at the image's edge
    can be thinner than the noise, and a detector returns no negative width.
    """
    noisy = box + noise
    lower = torch.minimum(noisy[:, :2], noisy[:, 2:])
    upper = torch.maximum(noisy[:, :2], noisy[:, 2:])
    return clip_box(torch.cat([lower, upper], dim=-1), camera)


@lru_cache(maxsize=16)
def _matrix(camera: CameraSpec) -> Matrix:
    """K Rᵀ, 3 x 3."""
    axes = rotation_matrix(np.array(camera.quat) / np.linalg.norm(camera.quat)).T  # right, down, forward
    return tuple(map(tuple, (np.array(camera.matrix) @ axes).tolist()))
