"""What counts as a detection, and the errors of the sight as they are drawn."""

from dataclasses import replace

import pytest
import torch

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.pinhole import nominal_projection, scaled_box
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.sensing import (
    CameraErrors,
    Detection,
    SensingCfg,
    detect,
    is_camera_exact,
    sample_camera_errors,
    tracked_position,
)
from pixel2catch.mdp.throws import Throw, ThrowCfg, sample_throws
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

CAMERA = nominal_projection(RGB_CAMERA, torch.zeros(1))


def detection(mark: float, num_envs: int = 1, **changes: torch.Tensor) -> Detection:
    fields = {
        "box": torch.full((num_envs, 4), mark),
        "object_pos": torch.full((num_envs, 3), -mark),
        "is_seen": torch.ones(num_envs, dtype=torch.bool),
        "stale": torch.zeros(num_envs),
        "age_error": torch.full((num_envs,), 0.1 * mark),
    }
    return Detection(**fields | changes)


def test_a_detection_grows_older_until_the_object_is_seen_again():
    seen, stale = detection(0.0), []
    for number, is_found in enumerate((True, False, False, True, False), start=1):
        seen = detection(float(number)).held(torch.tensor([is_found]), seen)
        stale.append((seen.box[0, 0].item(), seen.stale.item()))
    assert stale == [(1.0, 0.0), (1.0, 1.0), (1.0, 2.0), (4.0, 0.0), (4.0, 1.0)]


def test_an_image_between_two_control_steps_by_hand():
    """From 10 to 20 px in a step: 20 at the moment itself, 17.5 a quarter before it, 10 a whole step."""
    now, before = detection(20.0, 3), detection(10.0, 3)
    between = now.exposed_before(before, torch.tensor([0.0, 0.25, 1.0]))
    assert between.box[:, 0].tolist() == [20.0, 17.5, 10.0]
    assert between.object_pos[:, 0].tolist() == [-20.0, -17.5, -10.0]
    assert between.is_seen.all()
    assert between.stale.tolist() == [0.0] * 3


def in_front(depth: float = 2.0) -> torch.Tensor:
    """Twenty points on a segment across the optical axis, world frame [m]."""
    forward = torch.tensor([0.8746197, 0.0, -0.4848096])  # 29 degrees down, along x
    across = torch.stack([torch.zeros(20), torch.linspace(-0.03, 0.03, 20), torch.zeros(20)], dim=-1)
    return (torch.tensor(RGB_CAMERA.pos) + depth * forward + across)[None]


@pytest.mark.parametrize(("visible", "expected"), [(0, False), (1, False), (2, True), (20, True)])
def test_too_little_of_an_object_is_no_detection(visible, expected):
    """The box of all of it: 6 cm at 2 m are 618 * 0.06 / 2 = 18.5 px, about the optical axis."""
    found, is_seen = detect(in_front(), torch.arange(20)[None] < visible, 0.1, CAMERA)
    assert is_seen.item() is expected
    if visible == 20:
        middle, half = RGB_CAMERA.cx, 618.163 * 0.03 / 2
        assert found[0, 0::2].tolist() == pytest.approx([middle - half, middle + half], abs=0.1)


def test_an_object_behind_the_camera_or_beside_the_image_is_not_seen():
    everything = torch.ones(1, 20, dtype=torch.bool)
    assert not detect(in_front(-2.0), everything, 0.05, CAMERA)[1]
    assert not detect(in_front() + torch.tensor([0.0, 5.0, 0.0]), everything, 0.05, CAMERA)[1]


def test_a_camera_with_images_of_another_size_is_refused():
    with pytest.raises(InvalidValueError, match="1280 x 480 pixels; policies need 640 x 480"):
        SensingCfg(camera=CameraFile(camera=replace(RGB_CAMERA, width=1280)))


NUM_ENVS = 2000
ELSEWHERE = CameraFile(camera=replace(RGB_CAMERA, pos=(-0.5, 0.2, 2.0), fx=600.0, fy=601.0))
STDS = (0.01, 0.02, 0.03, 0.004, 0.005, 0.006)
MEASURED = replace(
    ELSEWHERE,
    pose_covariance=tuple(tuple(s * s if i == j else 0.0 for j in range(6)) for i, s in enumerate(STDS)),
    focal_std=0.02,
)


def draw(cfg: SensingCfg, num_envs: int = NUM_ENVS) -> tuple[CameraErrors, Throw]:
    generator = torch.Generator().manual_seed(0)
    throw = sample_throws(ThrowCfg(), num_envs, generator)
    return sample_camera_errors(cfg, throw, generator), throw


@pytest.mark.parametrize(
    ("changes", "is_exact"),
    [
        ({}, True),
        ({"camera": ELSEWHERE, "corner_noise": 9.0, "edge_noise": 2.0, "box_scale": 1.2}, True),
        *(({name: 0.01}, False) for name in ("camera_offset", "drop_rate", "clock_error", "stamp_jitter")),
        ({"camera_turn": (0.0, 0.01)}, False),
        ({"camera": replace(ELSEWHERE, focal_std=0.01)}, False),
    ],
)
def test_a_camera_with_any_error_is_not_exact(changes, is_exact):
    assert is_camera_exact(SensingCfg(**changes)) == is_exact


def focal_length(sight: CameraErrors, spec: CameraSpec = RGB_CAMERA) -> torch.Tensor:
    """fy [px]: with R's rows x, y, z the matrix is (fx x + cx z, fy y + cy z, z)."""
    return (sight.camera.matrix[:, 1] - spec.cy * sight.camera.matrix[:, 2]).norm(dim=-1)


def test_a_calibrated_camera_is_drawn_as_well_as_it_is_known():
    spec = ELSEWHERE.camera
    for focal_std, spread in ((0.02, 0.02), (None, 0.0)):
        sight, _ = draw(SensingCfg(camera=replace(MEASURED, focal_std=focal_std)))
        offset = sight.camera.center - torch.tensor(spec.pos)
        torch.testing.assert_close(offset.std(dim=0), torch.tensor(STDS[:3]), rtol=0.06, atol=0.0)
        assert (offset.mean(dim=0).abs() < 0.1 * torch.tensor(STDS[:3])).all()
        assert not sight.box_bias.any()
        factor = focal_length(sight, spec) / spec.fy
        assert factor.std().item() == pytest.approx(spread, rel=0.06, abs=1e-5)


@pytest.mark.parametrize(
    ("name", "amount", "drawn"),
    [
        ("camera_offset", 0.02, lambda sight: sight.camera.center - torch.tensor(RGB_CAMERA.pos)),
        ("focal_error", 0.05, lambda sight: focal_length(sight)[:, None] / RGB_CAMERA.fy - 1.0),
        ("box_bias", 5.0, lambda sight: sight.box_bias),
        ("clock_error", 0.02, lambda sight: CONTROL_DT * sight.clock_error[:, None]),
    ],
)
def test_an_error_has_its_size_in_every_direction_and_comes_alone(name, amount, drawn):
    sight, _ = draw(SensingCfg(**{name: amount}))
    error = drawn(sight)
    torch.testing.assert_close(error.norm(dim=-1), torch.full((NUM_ENVS,), amount), rtol=1e-3, atol=0)
    assert (error.mean(dim=0).abs() < 4.0 * amount / NUM_ENVS**0.5).all()
    assert bool(sight.box_bias.any()) == (name == "box_bias")


def test_a_turned_camera_is_turned_by_the_angle():
    """Of a rotation by angle a about axis k, trace = 1 + 2 cos(a)."""
    sight, _ = draw(SensingCfg(camera_turn=0.02))
    rotation = torch.linalg.solve(CAMERA.matrix, sight.camera.matrix).double()
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    angle = torch.acos((trace - 1.0).clamp(-2.0, 2.0) / 2.0)
    assert angle.median().item() == pytest.approx(0.02, rel=0.05)


def test_a_blackout_is_once_in_the_flight():
    sight, throw = draw(SensingCfg(blackout_steps=6))
    is_dark = torch.stack([sight.is_dark(torch.full((NUM_ENVS,), step)) for step in range(90)])
    assert (is_dark.sum(dim=0) == 6).all()
    first = is_dark.int().argmax(dim=0)
    assert (first >= throw.hover_steps).all()
    last_of_flight = throw.hover_steps + throw.flight_time() / CONTROL_DT
    assert (first + 6 <= last_of_flight + 0.5).all()
    share = (first - throw.hover_steps) / (throw.flight_time() / CONTROL_DT - 6.0)
    assert share.mean() == pytest.approx(0.5, abs=0.03)


def test_a_clock_is_wrong_by_as_much_in_every_image_of_an_episode():
    sight, _ = draw(SensingCfg(clock_error=0.02))
    generator = torch.Generator().manual_seed(0)
    for latency in (torch.zeros(NUM_ENVS), torch.full((NUM_ENVS,), 3.5)):
        assert torch.equal(sight.age_error(latency, generator), sight.clock_error)


def test_a_box_is_scaled_about_its_centre():
    """20 x 10 px about (110, 205), made 1.2 times larger: 24 x 12 about the same point."""
    box = torch.tensor([[100.0, 200.0, 120.0, 210.0]])
    torch.testing.assert_close(scaled_box(box, 1.2), torch.tensor([[98.0, 199.0, 122.0, 211.0]]))
    assert torch.equal(scaled_box(box, 1.0), box)


def test_a_shift_of_the_pixel_moves_the_tracked_position_across():
    """5 px at depth d are 5 d / fx: 2 cm at 2.5 m, across the optical axis, along -y for u."""
    forward = torch.tensor([0.8746197, 0.0, -0.4848096])
    object_pos = (torch.tensor(RGB_CAMERA.pos) + 2.5 * forward)[None]
    found = tracked_position(CAMERA, CAMERA, object_pos, torch.tensor([[5.0, 0.0]]))
    expected = torch.tensor([[0.0, -5.0 * 2.5 / RGB_CAMERA.fx, 0.0]])
    torch.testing.assert_close(found - object_pos, expected, atol=1e-5, rtol=0)


def test_a_misplaced_camera_misplaces_the_tracked_position_as_much():
    """The tracker reports where the object would be if the camera were where it is assumed."""
    object_pos = torch.tensor([[2.0, 0.1, 1.2]])
    offset = torch.tensor([[0.01, -0.02, 0.005]])
    found = tracked_position(CAMERA.moved(offset), CAMERA, object_pos, torch.zeros(1, 2))
    torch.testing.assert_close(found, object_pos - offset, atol=2e-6, rtol=0)
