"""Boxes of the level camera do not depend on where a camera looks, on its lens, or on its roll."""

from dataclasses import replace
from math import cos, radians, sin

import torch
from torch import Tensor

from pixel2catch.camera import region
from pixel2catch.camera.level import LEAST_DEPTH, LEVEL_CAMERA, level_boxes, level_sight
from pixel2catch.camera.pinhole import Projection, nominal_projection, project
from pixel2catch.scene.constants import FORWARD_TO_OPTICAL, RGB_CAMERA, quat_multiply

NUM = 500


def drawn_spheres() -> tuple[Projection, Tensor]:
    """Cameras of the region, and points on a sphere of 4 cm before each [m]."""
    generator = torch.Generator().manual_seed(1)
    cameras = region.sample(NUM, generator)
    place = torch.rand(NUM, 1, 3, generator=generator) * torch.tensor([2.0, 0.8, 1.0])
    rays = torch.randn(NUM, 3000, 3, generator=generator)
    return cameras, place + torch.tensor([0.8, -0.4, 0.9]) + 0.04 * torch.nn.functional.normalize(
        rays, dim=-1
    )


def box_of(camera: Projection, points: Tensor) -> Tensor:
    pixels, _ = camera.pixels(points)
    return torch.cat((pixels.amin(dim=1), pixels.amax(dim=1)), dim=-1)


def test_a_sphere_has_the_box_that_a_level_camera_at_the_same_place_sees():
    cameras, points = drawn_spheres()
    level = replace(nominal_projection(LEVEL_CAMERA, points), center=cameras.center)
    difference = (level_boxes(box_of(cameras, points), cameras) - box_of(level, points)).abs()
    assert difference.mean() < 0.1
    assert difference.quantile(0.98) < 0.5


def test_the_level_camera_itself_and_empty_boxes_stay():
    box = torch.tensor([[100.0, 50.0, 130.0, 90.0], [0.0, 0.0, 0.0, 0.0]])
    found = level_boxes(box, nominal_projection(LEVEL_CAMERA, box))
    torch.testing.assert_close(found, box, atol=1e-2, rtol=0)
    assert not level_boxes(box, nominal_projection(RGB_CAMERA, box))[1].any()


def test_the_region_has_the_camera_of_the_release_and_names_what_is_outside():
    assert not region.outside(RGB_CAMERA)
    assert "x is 0.30 m" in region.outside(replace(RGB_CAMERA, pos=(0.3, 0.0, 2.0)))
    assert "116° wide" in region.outside(replace(RGB_CAMERA, fx=200.0))
    assert "axis does not pass" in region.outside(replace(RGB_CAMERA, quat=FORWARD_TO_OPTICAL))
    rolled = replace(RGB_CAMERA, quat=(0.5, -0.5, 0.5, -0.5), pos=(-0.4, 0.0, 1.4))
    assert not region.outside(rolled)
    assert "90° about" in region.outside(replace(rolled, quat=(0.0, -0.7071068, 0.0, -0.7071068)))
    for degrees in (11, 170):  # of a camera that looks 29° down
        roll = (cos(radians(degrees / 2.0)), 0.0, 0.0, sin(radians(degrees / 2.0)))
        turned = replace(RGB_CAMERA, quat=quat_multiply(RGB_CAMERA.quat, roll))
        assert f"turned by {degrees}° about" in region.outside(turned)


def test_drawn_cameras_are_of_the_region():
    cameras = region.sample(20, torch.Generator().manual_seed(0))
    for matrix, center in zip(cameras.matrix.double(), cameras.center.tolist(), strict=True):
        right = matrix[0] - RGB_CAMERA.cx * matrix[2]
        focal = float(right.norm())
        axes = torch.stack((right / focal, (matrix[1] - RGB_CAMERA.cy * matrix[2]) / focal, matrix[2]))
        torch.testing.assert_close(axes @ axes.T, torch.eye(3).double(), atol=1e-5, rtol=0)
        camera = replace(RGB_CAMERA, fx=focal, fy=focal, pos=tuple(center), quat=quaternion(axes.T))
        assert not region.outside(camera)
        found = nominal_projection(camera, torch.zeros(0, dtype=torch.float64)).matrix
        torch.testing.assert_close(found, matrix, atol=1e-2, rtol=0)


def quaternion(turn: Tensor) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a rotation matrix with w not 0."""
    w = 0.5 * float(1.0 + turn.trace()) ** 0.5
    x, y, z = (float(turn[i, j] - turn[j, i]) / (4.0 * w) for i, j in ((2, 1), (0, 2), (1, 0)))
    return w, x, y, z


def test_a_palm_beside_or_behind_the_camera_has_bounded_coordinates():
    offsets = torch.linspace(-1.0, 1.0, 20_001)
    palms = torch.stack((offsets, torch.full_like(offsets, 0.8), torch.zeros_like(offsets)), dim=-1)
    for palm in (palms, torch.zeros(1, 3)):
        sight = level_sight(palm[:, None], torch.zeros(len(palm), 3))
        assert sight.isfinite().all()
        assert sight.abs().max() <= 1.3 / LEAST_DEPTH
    ahead = palms[15_000:, None]
    pixels, depth = project(LEVEL_CAMERA, ahead)
    axis, focal = torch.tensor(((RGB_CAMERA.cx, RGB_CAMERA.cy), (RGB_CAMERA.fx, RGB_CAMERA.fy)))
    expected = torch.cat(((pixels - axis) / focal, 1.0 / depth[..., None]), dim=-1)
    assert torch.equal(level_sight(ahead, torch.zeros(len(ahead), 3)), expected)
