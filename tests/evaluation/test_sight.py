"""Which throws a camera sees."""

from dataclasses import replace
from pathlib import Path

import pytest

from pixel2catch.cli.scene import Scene
from pixel2catch.envs.tasks import PEOPLE_THROWS
from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.sight import sight
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


def test_a_picture_needs_a_camera_and_a_model_has_none(tmp_path):
    for file, camera in (("a.png", None), ("a.xml", Path("people"))):
        with pytest.raises(InvalidValueError, match="--camera"):
            Scene(file=tmp_path / file, camera=camera).run()
