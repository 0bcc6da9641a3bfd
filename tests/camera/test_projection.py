"""Cameras that differ from the nominal one: what moves in the image, by how much, and back again."""

from math import tan

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.camera.pinhole import Projection, back_project, nominal_projection, project
from pixel2catch.scene.constants import RGB_CAMERA

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


@pytest.mark.parametrize("depth", [1.0, 2.5])
def test_a_camera_to_the_side_moves_a_point_the_other_way(depth):
    """By fx 0.02 / depth: 618.163 * 0.02 / 2.5 = 4.9 px."""
    camera = NOMINAL.moved(0.02 * RIGHT[None])
    assert shift(camera, ahead(depth)) == pytest.approx([-RGB_CAMERA.fx * 0.02 / depth, 0.0], abs=1e-5)


def test_a_camera_that_turns_to_the_left_moves_everything_right():
    """About the world's z axis a point ahead of a level camera moves by fx tan(angle); pitch shortens it."""
    camera = NOMINAL.turned(torch.tensor([[0.0, 0.0, 0.01]], dtype=torch.float64))
    moved = shift(camera, ahead(2.0))
    assert moved[0] == pytest.approx(RGB_CAMERA.fx * tan(0.01) * FORWARD[0].item(), rel=1e-3)
    assert abs(moved[1]) < 0.02


def test_turning_about_the_optical_axis_keeps_its_point_and_turns_the_others():
    camera = NOMINAL.turned(0.02 * FORWARD[None])
    assert shift(camera, ahead(2.0)) == pytest.approx([0.0, 0.0], abs=1e-4)
    beside = ahead(2.0) + 0.5 * RIGHT
    expected = RGB_CAMERA.fy * 0.5 / 2.0 * -torch.sin(torch.tensor(0.02)).item()
    assert shift(camera, beside)[1] == pytest.approx(expected, rel=1e-3)


def test_a_longer_focal_length_scales_about_the_principal_point():
    point = ahead(2.0) + 0.3 * RIGHT + torch.tensor([0.0, 0.0, 0.2])
    zoomed = NOMINAL.zoomed(torch.tensor([1.05], dtype=torch.float64), RGB_CAMERA).moved(torch.zeros(1, 3))
    principal = torch.tensor([RGB_CAMERA.cx, RGB_CAMERA.cy], dtype=torch.float64)
    before, after = project(RGB_CAMERA, point)[0] - principal, zoomed.pixels(point)[0] - principal
    torch.testing.assert_close(after, 1.05 * before)


@given(st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3))
def test_turning_there_and_back_is_no_turn(vector):
    rotation = torch.tensor([vector], dtype=torch.float64)
    turned = NOMINAL.turned(rotation)
    torch.testing.assert_close(turned.turned(-rotation).matrix[0], NOMINAL.matrix)
    rows = [torch.linalg.vector_norm(matrix, dim=-1) for matrix in (turned.matrix[0], NOMINAL.matrix)]
    torch.testing.assert_close(*rows)  # a rotation keeps lengths


@given(st.floats(0.5, 4.0), st.floats(-0.8, 0.8), st.floats(-0.5, 0.5))
def test_back_projection_is_the_inverse_of_projection(depth, across, up):
    point = ahead(depth) + across * RIGHT + torch.tensor([0.0, 0.0, up])
    pixels, depths = project(RGB_CAMERA, point)
    torch.testing.assert_close(back_project(RGB_CAMERA, pixels[:, 0], depths[:, 0]), point[:, 0])


def test_environments_have_cameras_of_their_own():
    camera = NOMINAL.moved(torch.stack((0.0 * RIGHT, 0.04 * RIGHT)))
    pixels, _ = camera.pixels(ahead(2.0).expand(2, 1, 3))
    assert (pixels[0] - pixels[1])[0, 0].item() == pytest.approx(RGB_CAMERA.fx * 0.02)
