"""The region of cameras for which policies for any camera are trained: uniform ranges in the world frame.

The cameras are behind and beside the robot and see throws from the front; that of the release is one of them.
The principal point is that of the release. Source: ours.
"""

from math import atan, atan2, degrees, radians

import torch
from torch import linalg

from pixel2catch.camera.pinhole import Projection, nominal_projection
from pixel2catch.devices import constant, uniform
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

POS = ((-1.2, 0.0), (-0.8, 0.8), (1.1, 2.3))  #: Position [m].
LOOK_AT = ((1.1, 1.8), (-0.25, 0.25), (1.2, 1.7))  #: A point on the optical axis [m].
ROLL = (-radians(10.0), radians(10.0))  #: Turn about the optical axis, from an image with level rows [rad].
VIEW_WIDTH = (radians(50.0), radians(90.0))  #: Horizontal angle of view [rad].


def sample(num_envs: int, generator: torch.Generator) -> Projection:
    """Draw cameras on the generator's device."""
    draws = uniform((*POS, *LOOK_AT, ROLL, VIEW_WIDTH), num_envs, generator)
    pos, look_at, roll, view_width = draws.split((3, 3, 1, 1), dim=-1)
    forward = torch.nn.functional.normalize(look_at - pos, dim=-1)
    up = constant((0.0, 0.0, 1.0), forward.device).expand_as(forward)
    level = torch.nn.functional.normalize(linalg.cross(forward, up), dim=-1)
    across = linalg.cross(forward, level)
    right = torch.cos(roll) * level + torch.sin(roll) * across
    down = torch.cos(roll) * across - torch.sin(roll) * level
    focal = 0.5 * RGB_CAMERA.width / torch.tan(0.5 * view_width)
    rows = (focal * right + RGB_CAMERA.cx * forward, focal * down + RGB_CAMERA.cy * forward, forward)
    return Projection(matrix=torch.stack(rows, dim=-2), center=pos)


def outside(camera: CameraSpec) -> str:
    """Return what of a camera is not within the region, in words; empty if all is."""
    found = nominal_projection(camera, torch.zeros(0, dtype=torch.float64))
    forward = found.matrix[2]
    right = (found.matrix[0] - camera.cx * forward) / camera.fx
    down = (found.matrix[1] - camera.cy * forward) / camera.fy
    ways = (torch.tensor(LOOK_AT) - found.center[:, None]) / forward[:, None]
    wrong = [
        f"{axis} is {value:.2f} m, trained were {low:g} to {high:g} m"
        for axis, value, (low, high) in zip("xyz", camera.pos, POS, strict=True)
        if not low <= value <= high
    ]
    if ways.amin(dim=1).amax() > ways.amax(dim=1).amin():
        box = ", ".join(
            f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", LOOK_AT, strict=True)
        )
        wrong.append(f"its axis does not pass through {box} m")
    for words, value, (low, high) in (
        ("its image is {:.0f}° wide", 2.0 * atan(0.5 * camera.width / camera.fx), VIEW_WIDTH),
        ("it is turned by {:.0f}° about its axis", atan2(-right[2], -down[2]), ROLL),
    ):
        if not low <= value <= high:
            trained = f"trained were {degrees(low):.0f} to {degrees(high):.0f}°"
            wrong.append(f"{words.format(degrees(value))}, {trained}")
    return "; ".join(wrong)
