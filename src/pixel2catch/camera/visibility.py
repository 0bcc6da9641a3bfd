"""Which surface points of the object the camera sees.

One ray runs from the camera to each point; whoever owns the geometry casts it (`Simulation.ray`) against the
robot and the table, and hands back the distances. The object itself is not cast against: its far side
projects into its own outline.
"""

from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.camera.pinhole import camera_center
from pixel2catch.scene.constants import CameraSpec


def ray_directions(
    camera: CameraSpec, points: Float[Tensor, "num_envs num_points 3"]
) -> Float[Tensor, "num_envs num_points 3"]:
    """Return the rays from the camera's centre to the points, world frame [m]; not normalised."""
    return points - camera_center(camera, points)


def is_unoccluded(hit_distance: Float[Tensor, "num_envs num_points"]) -> Bool[Tensor, "num_envs num_points"]:
    """Return whether nothing stands between the camera and each point.

    Args:
        hit_distance: Where the ray of `ray_directions` first hits robot or table, in units of the ray: 1 is
            at the point, negative is a miss.
    """
    return (hit_distance < 0.0) | (hit_distance >= 1.0)


def is_in_view(
    camera: CameraSpec,
    pixels: Float[Tensor, "num_envs num_points 2"],
    depth: Float[Tensor, "num_envs num_points"],
) -> Bool[Tensor, "num_envs num_points"]:
    """Return whether each projected point lies in front of the camera and on the image."""
    u, v = pixels.unbind(-1)
    return (depth > 0.0) & (u >= 0.0) & (u <= camera.width) & (v >= 0.0) & (v <= camera.height)
