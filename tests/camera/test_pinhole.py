import math

import pytest
import torch

from pixel2catch.camera.pinhole import is_in_view, is_unoccluded, project
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


def test_single_precision_is_enough():
    extent, corner = torch.tensor([2.5, 0.6, 1.5]), torch.tensor([0.3, -0.3, 0.5])
    points = torch.rand(100, 50, 3, dtype=torch.float64) * extent + corner
    exact, _ = project(RGB_CAMERA, points)
    single, _ = project(RGB_CAMERA, points.float())
    assert single.dtype == torch.float32
    assert (single - exact).abs().max() < 1e-3


def test_a_miss_or_a_hit_behind_the_point_hides_nothing():
    hits = torch.tensor([[-1.0, 0.999, 1.0, 1.5, 0.0]])
    assert is_unoccluded(hits).tolist() == [[True, False, True, True, False]]


def test_in_view_is_on_the_image_and_in_front():
    # Straight ahead; behind the camera on the same line; far to the left; under the lower edge.
    points = torch.tensor([[[1.5, 0.0, 1.2], [-2.28, 0.02, 3.2], [1.5, 3.0, 1.2], [0.2, 0.0, 0.5]]])
    pixels, depth = project(RGB_CAMERA, points)
    assert (depth[0] > 0).tolist() == [True, False, True, True]
    assert is_in_view(RGB_CAMERA, pixels, depth).tolist() == [[True, False, False, False]]
