"""What counts as a detection, and what becomes of an object that is not seen."""

from dataclasses import replace

import pytest
import torch

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.sensing import Detection, SensingCfg, detect
from pixel2catch.scene.constants import RGB_CAMERA


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
    found, is_seen = detect(in_front(), torch.arange(20)[None] < visible, 0.1)
    assert is_seen.item() is expected
    if visible == 20:
        middle, half = RGB_CAMERA.cx, 618.163 * 0.03 / 2
        assert found[0, 0::2].tolist() == pytest.approx([middle - half, middle + half], abs=0.1)


def test_an_object_behind_the_camera_or_beside_the_image_is_not_seen():
    everything = torch.ones(1, 20, dtype=torch.bool)
    assert not detect(in_front(-2.0), everything, 0.05)[1]
    assert not detect(in_front() + torch.tensor([0.0, 5.0, 0.0]), everything, 0.05)[1]


def test_a_camera_with_images_of_another_size_is_refused():
    with pytest.raises(InvalidValueError, match="1280 x 480 pixels; policies need 640 x 480"):
        SensingCfg(camera=CameraFile(camera=replace(RGB_CAMERA, width=1280)))
