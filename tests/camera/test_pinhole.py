"""The pinhole camera: projection, its errors, and boxes of what it sees."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pixel2catch.camera.pinhole import (
    Projection,
    box_of_points,
    clip_box,
    is_in_view,
    is_unoccluded,
    nominal_projection,
    perturb_box,
    project,
)
from pixel2catch.scene.constants import RGB_CAMERA

AT_ORIGIN = replace(
    RGB_CAMERA, fx=600.0, fy=500.0, cx=320.0, cy=240.0, pos=(0.0, 0.0, 0.0), quat=(1.0, 0.0, 0.0, 0.0)
)


def test_numbers_by_hand():
    # u = 600 * 0.1 / 2 + 320 = 350, v = 500 * -0.4 / 2 + 240 = 140
    pixels, depth = project(AT_ORIGIN, torch.tensor([[[0.1, -0.4, 2.0]]]))
    torch.testing.assert_close(pixels, torch.tensor([[[350.0, 140.0]]]))
    torch.testing.assert_close(depth, torch.tensor([[2.0]]))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_single_precision_is_enough(device: str):
    """On a GPU, too, which could round products to TF32."""
    extent, corner = torch.tensor([2.5, 0.6, 1.5]), torch.tensor([0.3, -0.3, 0.5])
    points = torch.rand(100, 50, 3, dtype=torch.float64) * extent + corner
    exact, _ = project(RGB_CAMERA, points)
    single, _ = project(RGB_CAMERA, points.float().to(device))
    assert single.dtype == torch.float32
    assert (single.cpu() - exact).abs().max() < 1e-3


def test_a_miss_or_a_hit_behind_the_point_hides_nothing():
    hits = torch.tensor([[-1.0, 0.999, 1.0, 1.5, 0.0]])
    assert is_unoccluded(hits).tolist() == [[True, False, True, True, False]]


def test_in_view_is_on_the_image_and_in_front():
    # Straight ahead; behind the camera on the same line; far to the left; under the lower edge.
    points = torch.tensor([[[1.5, 0.0, 1.2], [-2.28, 0.02, 3.2], [1.5, 3.0, 1.2], [0.2, 0.0, 0.5]]])
    pixels, depth = project(RGB_CAMERA, points)
    assert (depth[0] > 0).tolist() == [True, False, True, True]
    assert is_in_view(RGB_CAMERA, pixels, depth).tolist() == [[True, False, False, False]]


FORWARD = torch.tensor([0.8746197, 0.0, -0.4848096], dtype=torch.float64)
RIGHT = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
EYE = torch.tensor(RGB_CAMERA.pos, dtype=torch.float64)
NOMINAL = nominal_projection(RGB_CAMERA, EYE)


def ahead(depth: float) -> torch.Tensor:
    """A point on the optical axis, one environment, world frame [m]."""
    return (EYE + depth * FORWARD)[None, None]


def shift(camera: Projection, point: torch.Tensor) -> list[float]:
    """How far a point moves in the image [px]."""
    return (camera.pixels(point)[0] - project(RGB_CAMERA, point)[0])[0, 0].tolist()


def test_a_camera_to_the_side_moves_a_point_the_other_way():
    """By fx 0.02 / depth: 618.163 * 0.02 / 2.5 = 4.9 px; each environment has a camera of its own."""
    camera = NOMINAL.moved(torch.stack((0.02 * RIGHT, 0.04 * RIGHT)))
    pixels = camera.pixels(ahead(2.5).expand(2, 1, 3))[0] - project(RGB_CAMERA, ahead(2.5))[0]
    for moved, step in zip(pixels[:, 0].tolist(), (0.02, 0.04), strict=True):
        assert moved == pytest.approx([-RGB_CAMERA.fx * step / 2.5, 0.0], abs=1e-5)


def test_a_camera_that_turns_to_the_left_moves_everything_right():
    """About the world's z axis a point ahead of a level camera moves by fx tan(angle); pitch shortens it."""
    camera = NOMINAL.turned(torch.tensor([[0.0, 0.0, 0.01]], dtype=torch.float64))
    moved = shift(camera, ahead(2.0))
    assert moved[0] == pytest.approx(RGB_CAMERA.fx * math.tan(0.01) * FORWARD[0].item(), rel=1e-3)
    assert abs(moved[1]) < 0.02


def test_a_longer_focal_length_scales_about_the_principal_point():
    point = ahead(2.0) + 0.3 * RIGHT + torch.tensor([0.0, 0.0, 0.2])
    zoomed = NOMINAL.zoomed(torch.tensor([1.05], dtype=torch.float64), RGB_CAMERA).moved(torch.zeros(1, 3))
    principal = torch.tensor([RGB_CAMERA.cx, RGB_CAMERA.cy], dtype=torch.float64)
    before, after = project(RGB_CAMERA, point)[0] - principal, zoomed.pixels(point)[0] - principal
    torch.testing.assert_close(after, 1.05 * before)


@given(st.floats(0.5, 4.0), st.floats(-0.8, 0.8), st.floats(-0.5, 0.5))
def test_back_projection_is_the_inverse_of_projection(depth, across, up):
    point = ahead(depth) + across * RIGHT + torch.tensor([0.0, 0.0, up])
    pixels, depths = project(RGB_CAMERA, point)
    found = nominal_projection(RGB_CAMERA, point).points(pixels[:, 0], depths[:, 0])
    torch.testing.assert_close(found, point[:, 0])


@pytest.mark.parametrize(
    ("pixels", "num_visible", "expected"),
    [
        ([(10, 20), (30, 25), (15, 40), (600, 400)], 3, [10, 20, 30, 40]),  # of the visible points
        ([(20, 470), (25, 475), (50, 490)], 3, [20, 470, 25, 480]),  # one below bounds neither left nor right
        ([(-9, 4), (3, 5), (-2, -8)], 3, [0, 5, 3, 5]),  # one beyond the corner bounds nothing
        ([(20, 490), (-5, 300)], 2, [0] * 4),  # off the image
        ([(torch.inf, torch.nan)], 0, [0] * 4),  # nothing visible
    ],
)
def test_box_of_points(pixels, num_visible, expected):
    is_visible = torch.arange(len(pixels))[None] < num_visible
    assert box_of_points(torch.tensor([pixels]).float(), is_visible, RGB_CAMERA).tolist() == [expected]


@pytest.mark.parametrize(
    ("box", "noise", "expected"),
    [
        ([100, 110, 130, 150], [1, -2, 3, -4], [101, 108, 133, 146]),
        ([100, 478, 120, 480], [0, 1.5, 0, -4], [100, 476, 120, 479.5]),  # edges that cross are exchanged
    ],
)
def test_each_edge_moves_by_its_own_noise(box, noise, expected):
    boxes, errors = torch.tensor([box]).float(), torch.tensor([noise]).float()
    assert perturb_box(boxes, errors, RGB_CAMERA).tolist() == [expected]


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), reach=st.floats(0.0, 5.0))
def test_noise_keeps_boxes_in_order_and_in_the_image(seed: int, reach: float):
    generator = torch.Generator().manual_seed(seed)
    corners = torch.rand(50, 2, 2, generator=generator) * torch.tensor([640.0, 480.0])
    box = torch.cat([corners.amin(1), corners.amax(1)], dim=-1)
    noise = (2 * torch.rand(50, 4, generator=generator) - 1) * reach
    noisy = perturb_box(box, noise, RGB_CAMERA)
    assert (noisy[:, :2] <= noisy[:, 2:]).all()
    torch.testing.assert_close(clip_box(noisy, RGB_CAMERA), noisy, atol=0, rtol=0)
    assert (noisy - box).abs().max() <= reach + 1e-4
