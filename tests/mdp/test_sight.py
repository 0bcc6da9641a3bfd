"""Errors of the sight as they are drawn, and what they do to boxes and to a tracked position."""

from dataclasses import replace

import pytest
import torch

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.sight import Sight, sample_sight, scaled_box, tracked_position
from pixel2catch.mdp.throws import Throw, ThrowCfg, sample_throws
from pixel2catch.robot.constants import CONTROL_DT, RGB_CAMERA

NUM_ENVS = 2000
ELSEWHERE = CameraFile(camera=replace(RGB_CAMERA, pos=(-0.5, 0.2, 2.0), fx=600.0, fy=601.0))
STDS = (0.01, 0.02, 0.03, 0.004, 0.005, 0.006)
MEASURED = replace(
    ELSEWHERE,
    pose_covariance=tuple(tuple(s * s if i == j else 0.0 for j in range(6)) for i, s in enumerate(STDS)),
    focal_std=0.02,
)


def draw(cfg: SensingCfg, num_envs: int = NUM_ENVS) -> tuple[Sight, Throw]:
    generator = torch.Generator().manual_seed(0)
    throw = sample_throws(ThrowCfg(), num_envs, generator)
    sight = sample_sight(cfg, throw, generator)
    assert sight is not None
    return sight, throw


def test_nothing_is_drawn_where_nothing_is_wrong():
    generator = torch.Generator().manual_seed(0)
    throw = sample_throws(ThrowCfg(), 3, generator)
    before = generator.get_state()
    for cfg in (SensingCfg(), SensingCfg(camera=ELSEWHERE)):
        assert sample_sight(cfg, throw, generator) is None
    assert torch.equal(generator.get_state(), before)


def test_a_calibrated_camera_is_drawn_as_well_as_it_is_known():
    """With R's rows x, y, z the matrix is (fx x + cx z, fy y + cy z, z): the second row gives fy."""
    spec = ELSEWHERE.camera
    for focal_std, spread in ((0.02, 0.02), (None, 0.0)):
        sight, _ = draw(SensingCfg(camera=replace(MEASURED, focal_std=focal_std)))
        offset = sight.camera.center - torch.tensor(spec.pos)
        torch.testing.assert_close(offset.std(dim=0), torch.tensor(STDS[:3]), rtol=0.06, atol=0.0)
        assert (offset.mean(dim=0).abs() < 0.1 * torch.tensor(STDS[:3])).all()
        assert not sight.box_bias.any()
        matrix = sight.camera.matrix
        focal_length = (matrix[:, 1] - spec.cy * matrix[:, 2]).norm(dim=-1)
        assert (focal_length / spec.fy).std().item() == pytest.approx(spread, rel=0.06, abs=1e-5)


def test_a_mount_is_off_by_as_much_about_a_calibrated_camera():
    sight, _ = draw(SensingCfg(camera=ELSEWHERE, camera_offset=0.02))
    offset = sight.camera.center - torch.tensor(ELSEWHERE.camera.pos)
    torch.testing.assert_close(offset.norm(dim=-1), torch.full((NUM_ENVS,), 0.02), rtol=1e-4, atol=0)
    both, _ = draw(SensingCfg(camera=MEASURED, camera_offset=0.5))
    offset = both.camera.center - torch.tensor(ELSEWHERE.camera.pos)
    assert offset.norm(dim=-1).std().item() == pytest.approx(0.022, rel=0.15)  # √((1² + 2² + 3²) / 3) cm


def test_a_misplaced_camera_is_as_far_away_as_said_in_every_direction():
    sight, _ = draw(SensingCfg(camera_offset=0.02))
    offset = sight.camera.center - nominal_projection(RGB_CAMERA, torch.zeros(1)).center
    torch.testing.assert_close(offset.norm(dim=-1), torch.full((NUM_ENVS,), 0.02), rtol=1e-4, atol=0)
    assert offset.mean(dim=0).abs().max() < 0.001
    assert not sight.box_bias.any()


def test_a_turned_camera_is_turned_by_the_angle():
    """Of a rotation by angle a about axis k, trace = 1 + 2 cos(a)."""
    sight, _ = draw(SensingCfg(camera_turn=0.02))
    nominal = nominal_projection(RGB_CAMERA, torch.zeros(1)).matrix
    rotation = torch.linalg.solve(nominal, sight.camera.matrix).double()
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    angle = torch.acos((trace - 1.0).clamp(-2.0, 2.0) / 2.0)
    assert angle.median().item() == pytest.approx(0.02, rel=0.05)


def test_a_focal_error_has_either_sign():
    sight, _ = draw(SensingCfg(focal_error=0.05))
    point = torch.tensor([[[2.0, 0.4, 1.0]]])
    principal = torch.tensor([RGB_CAMERA.cx, RGB_CAMERA.cy])
    nominal = nominal_projection(RGB_CAMERA, point).pixels(point)[0] - principal
    factor = (sight.camera.pixels(point.expand(NUM_ENVS, 1, 3))[0] - principal) / nominal
    assert sorted({round(value, 3) for value in factor.flatten().tolist()}) == [0.95, 1.05]
    assert (factor[:, 0, 0] > 1.0).float().mean() == pytest.approx(0.5, abs=0.05)


def test_a_bias_has_its_length_in_every_direction_of_the_image():
    sight, _ = draw(SensingCfg(box_bias=5.0))
    torch.testing.assert_close(sight.box_bias.norm(dim=-1), torch.full((NUM_ENVS,), 5.0))
    assert sight.box_bias.mean(dim=0).abs().max() < 0.3


def test_a_blackout_is_once_in_the_flight():
    sight, throw = draw(SensingCfg(blackout_steps=6))
    is_dark = torch.stack([sight.is_dark(torch.full((NUM_ENVS,), step), 6) for step in range(90)])
    assert (is_dark.sum(dim=0) == 6).all()
    first = is_dark.int().argmax(dim=0)
    assert (first >= throw.hover_steps).all()
    last_of_flight = throw.hover_steps + throw.flight_time() / CONTROL_DT
    assert (first + 6 <= last_of_flight + 0.5).all()
    share = (first - throw.hover_steps) / (throw.flight_time() / CONTROL_DT - 6.0)
    assert share.mean() == pytest.approx(0.5, abs=0.03)


def test_a_box_is_scaled_about_its_centre():
    """20 x 10 px about (110, 205), made 1.2 times larger: 24 x 12 about the same point."""
    box = torch.tensor([[100.0, 200.0, 120.0, 210.0]])
    torch.testing.assert_close(scaled_box(box, 1.2), torch.tensor([[98.0, 199.0, 122.0, 211.0]]))
    assert torch.equal(scaled_box(box, 1.0), box)


def test_a_tracker_without_errors_is_exact():
    object_pos = sample_throws(ThrowCfg(), 100, torch.Generator().manual_seed(1)).pos
    for camera in (RGB_CAMERA, ELSEWHERE.camera):
        found = tracked_position(
            nominal_projection(camera, object_pos), camera, object_pos, torch.zeros(100, 2)
        )
        torch.testing.assert_close(found, object_pos, atol=2e-6, rtol=0)


def test_a_shift_of_the_pixel_moves_the_tracked_position_across():
    """5 px at depth d are 5 d / fx: 2 cm at 2.5 m, across the optical axis, along -y for u."""
    forward = torch.tensor([0.8746197, 0.0, -0.4848096])
    object_pos = (torch.tensor(RGB_CAMERA.pos) + 2.5 * forward)[None]
    nominal = nominal_projection(RGB_CAMERA, object_pos)
    found = tracked_position(nominal, RGB_CAMERA, object_pos, torch.tensor([[5.0, 0.0]]))
    expected = torch.tensor([[0.0, -5.0 * 2.5 / RGB_CAMERA.fx, 0.0]])
    torch.testing.assert_close(found - object_pos, expected, atol=1e-5, rtol=0)


def test_a_misplaced_camera_misplaces_the_tracked_position_as_much():
    """The tracker reports where the object would be if the camera were where it is assumed."""
    object_pos = torch.tensor([[2.0, 0.1, 1.2]])
    offset = torch.tensor([[0.01, -0.02, 0.005]])
    camera = nominal_projection(RGB_CAMERA, object_pos).moved(offset)
    found = tracked_position(camera, RGB_CAMERA, object_pos, torch.zeros(1, 2))
    torch.testing.assert_close(found, object_pos - offset, atol=2e-6, rtol=0)


def test_the_size_of_each_error_is_its_own_switch():
    for change in ({"camera_offset": 0.01}, {"camera_turn": 0.01}, {"focal_error": 0.02}):
        sight, _ = draw(replace(SensingCfg(), **change), num_envs=8)
        nominal = nominal_projection(RGB_CAMERA, torch.zeros(1))
        is_moved = not torch.allclose(sight.camera.center, nominal.center.expand(8, 3))
        assert is_moved == ("camera_offset" in change)
