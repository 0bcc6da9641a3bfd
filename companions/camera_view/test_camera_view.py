"""Which throws a camera sees."""

from dataclasses import replace
from pathlib import Path

import pytest

from camera_view import main, sight, uncertainty
from pixel2catch.envs.tasks import PEOPLE_THROWS
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.scene.constants import FORWARD_TO_OPTICAL, PEOPLE_CAMERA, RGB_CAMERA


def test_the_release_sees_its_own_throws_and_the_other_camera_those_of_people():
    assert sight(RGB_CAMERA, ThrowCfg()).share > 0.99
    assert sight(RGB_CAMERA, PEOPLE_THROWS).share < 0.65
    assert sight(PEOPLE_CAMERA, PEOPLE_THROWS).share > 0.95


def test_sizes_and_times_by_hand():
    """A level camera under the way, 2 m from the release: 618 px over 200 cm there; the aim is behind it."""
    fixed = {"release_x": 3.0, "release_y": 0.0, "release_z": 1.0, "aim_x": 0.7, "aim_y": 0.0, "aim_z": 1.0}
    throw = replace(ThrowCfg(), peak_z=(1.2, 1.2), **{name: (value, value) for name, value in fixed.items()})
    found = sight(replace(RGB_CAMERA, pos=(1.0, 0.0, 1.0), quat=FORWARD_TO_OPTICAL), throw)
    assert found.release_size == pytest.approx(618.163 / 200.0)
    assert found.catch == 0.0
    assert found.time == pytest.approx(2.0 * (2.0 * 0.2 / 9.81) ** 0.5)
    assert 0.5 < found.share < 2.0 / 2.3  # it passes above the image, then the camera


def test_the_place_of_the_fall_is_as_uncertain_as_the_aim_without_boxes_and_known_by_exact_ones():
    """Aims are uniform over 20 cm along the view and 2 cm across."""
    places = {"release_x": (2.6, 2.61), "release_y": (0.0, 0.01), "peak_z": (1.75, 1.76)}
    throws = replace(ThrowCfg(), aim_y=(-0.01, 0.01), aim_z=(1.0, 1.01), **places)
    without = uncertainty(RGB_CAMERA, throws, error=1e6)
    assert without == pytest.approx((0.2 / 12**0.5, 0.02 / 12**0.5), rel=0.1)
    assert max(uncertainty(RGB_CAMERA, throws, error=1e-4)) < 1e-3


def test_the_command_prints_and_draws_what_a_camera_sees(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main(["people", str(tmp_path / "view.png")])
    assert "throws of people: 97%" in (printed := capsys.readouterr().out)
    assert "boxes 5 px off" in printed
    assert (tmp_path / "view.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit, match="camera is 'nowhere', which is not there"):
        main(["nowhere", str(tmp_path / "view.png")])
