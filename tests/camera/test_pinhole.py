import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.camera.pinhole import project
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

AT_ORIGIN = CameraSpec(
    width=640,
    height=480,
    fx=600.0,
    fy=500.0,
    cx=320.0,
    cy=240.0,
    pos=(0.0, 0.0, 0.0),
    quat=(1.0, 0.0, 0.0, 0.0),
)


def test_numbers_by_hand():
    # u = 600 * 0.1 / 2 + 320 = 350, v = 500 * -0.4 / 2 + 240 = 140
    pixels, depth = project(AT_ORIGIN, torch.tensor([[[0.1, -0.4, 2.0]]]))
    torch.testing.assert_close(pixels, torch.tensor([[[350.0, 140.0]]]))
    torch.testing.assert_close(depth, torch.tensor([[2.0]]))


def test_optical_axis_of_the_rgb_camera():
    # Forward axis pitched down by 29 degrees; two metres along it, then 0.1 m to the robot's left (world +y).
    pitch = 2 * math.atan2(0.25038, 0.96814764)
    assert math.degrees(pitch) == pytest.approx(29.0, abs=0.01)
    ahead, below = 2 * math.cos(pitch), 2 * math.sin(pitch)
    on_axis = torch.tensor([-0.39 + ahead, 0.01, 2.2 - below], dtype=torch.float64)
    to_the_left = on_axis + torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)
    pixels, depth = project(RGB_CAMERA, torch.stack([on_axis, to_the_left])[None])
    expected = torch.tensor([[[328.451, 246.513], [328.451 - 618.163 * 0.05, 246.513]]], dtype=torch.float64)
    torch.testing.assert_close(pixels, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(depth, torch.full((1, 2), 2.0, dtype=torch.float64))


@given(scale=st.floats(0.1, 10.0), x=st.floats(-1, 1), y=st.floats(-1, 1), z=st.floats(0.2, 4))
def test_a_ray_is_a_pixel(scale: float, x: float, y: float, z: float):
    """Points on one ray through the centre share their pixel; the depth grows with the distance."""
    point = torch.tensor([[[x, y, z]]], dtype=torch.float64)
    pixels, depth = project(AT_ORIGIN, point)
    pixels_far, depth_far = project(AT_ORIGIN, scale * point)
    torch.testing.assert_close(pixels_far, pixels, atol=1e-8, rtol=1e-8)
    torch.testing.assert_close(depth_far, scale * depth)


def test_single_precision_is_enough():
    extent, corner = torch.tensor([2.5, 0.6, 1.5]), torch.tensor([0.3, -0.3, 0.5])
    points = torch.rand(100, 50, 3, dtype=torch.float64) * extent + corner
    exact, _ = project(RGB_CAMERA, points)
    single, _ = project(RGB_CAMERA, points.float())
    assert single.dtype == torch.float32
    assert (single - exact).abs().max() < 1e-3
