"""The camera file: what it says comes back, and what it cannot mean is refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.pinhole import project
from pixel2catch.errors import InvalidValueError
from pixel2catch.scene.constants import RGB_CAMERA

STDS = (0.01, 0.02, 0.03, 0.004, 0.005, 0.006)
FILE = CameraFile(
    camera=replace(RGB_CAMERA, pos=(-0.4, 0.0, 2.1)),
    distortion=(0.1, -0.2, 0.001, 0.0),
    pose_covariance=tuple(tuple(s * s if i == j else 0.0 for j in range(6)) for i, s in enumerate(STDS)),
    focal_std=2e-3,
)
POINTS = torch.tensor([[[0.8, 0.1, 1.0], [2.5, -0.2, 0.8]]])


def test_what_is_saved_comes_back(tmp_path: Path):
    for file in (FILE, CameraFile(camera=RGB_CAMERA)):
        file.save(tmp_path / "camera.json")
        assert CameraFile.load(tmp_path / "camera.json") == file
    assert FILE.pose_std == pytest.approx(STDS)


def test_drawn_cameras_have_the_covariance():
    cameras = FILE.sample(20_000, torch.Generator().manual_seed(0))
    offset = cameras.center - torch.tensor(FILE.camera.pos)
    torch.testing.assert_close(offset.std(dim=0), torch.tensor(STDS[:3]), rtol=0.03, atol=0.0)
    # A small turn about the axes of the world changes the optical axis by its cross product with it.
    axis, turn = cameras.matrix[:, 2], torch.tensor(STDS[3:])
    square, pairs = axis.mean(dim=0) ** 2, ((1, 2), (2, 0), (0, 1))
    expected = [(turn[i] ** 2 * square[j] + turn[j] ** 2 * square[i]).sqrt() for i, j in pairs]
    torch.testing.assert_close(axis.std(dim=0), torch.stack(expected), rtol=0.03, atol=1e-5)


def test_a_camera_that_is_known_is_drawn_as_it_is():
    pixels, _ = CameraFile(camera=RGB_CAMERA).sample(3, torch.Generator()).pixels(POINTS.expand(3, -1, -1))
    torch.testing.assert_close(pixels, project(RGB_CAMERA, POINTS)[0].expand(3, -1, -1))


def test_a_seed_draws_such_a_camera():
    for seed in range(3):
        pixels, depth = FILE.sample(1, torch.Generator().manual_seed(seed)).pixels(POINTS)
        torch.testing.assert_close(project(FILE.drawn(seed), POINTS), (pixels, depth))
    assert CameraFile(camera=RGB_CAMERA).drawn(0) == RGB_CAMERA


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("format_version", 99, "format_version is 99, this code reads 1"),
        ("camera.fx", None, "field 'camera.fx': it is missing"),
        ("camera.fx", -1.0, "camera.fx is -1; it must be from 1"),
        ("camera.zoom", 2.0, "unknown field 'camera.zoom'"),
        ("camera.quat", [1.0, 1.0, 0.0, 0.0], "it must have length 1"),
        ("distortion", [0.1], "distortion has 1 numbers"),
        ("pose_covariance", [[1.0]], "6 rows of 6"),
        ("pose_covariance", [[-1.0 * (i == j) for j in range(6)] for i in range(6)], "negative variances"),
        ("focal_std", -0.1, "focal_std is -0.1"),
    ],
)
def test_a_bad_entry_is_refused_by_name(tmp_path: Path, name: str, value: object, words: str):
    """None removes the entry."""
    path = tmp_path / "camera.json"
    FILE.save(path)
    content = json.loads(path.read_text())
    place, _, entry = name.rpartition(".")
    holder = content[place] if place else content
    holder[entry] = value
    if value is None:
        del holder[entry]
    path.write_text(json.dumps(content))
    with pytest.raises(InvalidValueError, match="Calibrate again, or correct that entry") as error:
        CameraFile.load(path)
    assert words in str(error.value)
