"""`pixel2catch calibrate` on rendered images of the printed board in the hand."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_views import board_in_camera, poses, rendered

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.cli.main import main
from pixel2catch.perception.calibration.lens import SQUARE, CharucoBoard, read_image
from pixel2catch.robots.ur5e import ARM
from pixel2catch.scene.constants import RGB_CAMERA

JOINTS = [joint.name for joint in ARM.joints]
NUM_IMAGES = 8


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of the board in the hand, one of nothing, a table, and the lens."""
    folder = tmp_path_factory.mktemp("laboratory")
    rng = np.random.default_rng(0)
    rows = []
    for i, joint_pos in enumerate(poses(NUM_IMAGES, seed=2)):
        cv2.imwrite(str(folder / f"{i}.png"), rendered(board_in_camera(joint_pos), rng))
        rows.append([f"{i}.png", *joint_pos])
    cv2.imwrite(str(folder / "blank.png"), np.full((480, 640, 3), 90, dtype=np.uint8))
    write_table(folder / "views.csv", [*rows, ["blank.png", *rows[0][1:]]])
    CameraFile(camera=RGB_CAMERA).save(folder / "lens.json")
    return folder


def write_table(path: Path, rows: list[list], names: list[str] | None = None) -> Path:
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([names or ["image", *JOINTS], *rows])
    return path


def read_rows(folder: Path) -> list[list]:
    """Rows of the table, with whole paths of the images."""
    with open(folder / "views.csv", newline="", encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    return [[str(folder / name), *map(float, positions)] for name, *positions in rows]


def error_of(capsys: pytest.CaptureFixture[str], *args: str | Path) -> str:
    assert main(["calibrate", *map(str, args)]) == 2
    return capsys.readouterr().err


def test_finds_the_camera_that_took_the_images(
    laboratory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "new" / "camera.json"
    args = [laboratory / "views.csv", "--intrinsics", laboratory / "lens.json", "--out", out]
    assert main(["calibrate", *map(str, args)]) == 0
    printed = capsys.readouterr()
    assert "no board found in 1 of 9 images: blank.png" in printed.err
    for words in ("Reprojection error: 0.", "worst image", "within the noise of 5 px", "±"):
        assert words in printed.out
    found = CameraFile.load(out)
    assert np.linalg.norm(np.subtract(found.camera.pos, RGB_CAMERA.pos)) < 5e-3
    assert max(found.pos_std) < 5e-3
    assert "exists" in error_of(capsys, *args)
    assert CameraFile.load(out) == found


def test_the_printed_squares_have_their_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """At 300 dots an inch; the board is found on the page itself, which is not overwritten."""
    path = tmp_path / "board.png"
    assert main(["calibrate", "--print-marker", str(path)]) == 0
    view = CharucoBoard().find(read_image(path))
    assert view is not None
    edge = 1e-3 * 25.4 / 300 * np.linalg.norm(view.pixels[1] - view.pixels[0])
    assert edge == pytest.approx(SQUARE, rel=2e-3)
    assert "exists" in error_of(capsys, "--print-marker", path)


def test_a_table_that_cannot_be_is_refused(
    laboratory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    rows = read_rows(laboratory)
    lens = ("--intrinsics", laboratory / "lens.json", "--out", tmp_path / "camera.json")
    degrees = [[name, *np.degrees(positions)] for name, *positions in rows]
    cases = {
        "no column image": (rows, ["picture", *JOINTS]),
        "no column wrist_3_joint": (rows, ["image", *JOINTS[:5], "wrist_4_joint"]),
        "if the file is in degrees, convert it to radians": (degrees, None),
        "5 images show the board in the hand, 6 are needed": (rows[:5], None),
        "nowhere.png'. Correct its name, or leave it out": ([["nowhere.png", *rows[0][1:]], *rows], None),
    }
    for words, (table, names) in cases.items():
        assert words in error_of(capsys, write_table(tmp_path / "views.csv", table, names), *lens)
    assert not (tmp_path / "camera.json").exists()


def test_images_of_another_size_are_refused(
    laboratory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((240, 320, 3), dtype=np.uint8))
    row = [small, *read_rows(laboratory)[0][1:]]
    table = write_table(tmp_path / "views.csv", [row] * 6)
    out = ("--out", tmp_path / "camera.json")
    assert "(240, 320, 3)" in error_of(capsys, table, "--intrinsics", laboratory / "lens.json", *out)
    lens = tmp_path / "wide.json"
    text = (laboratory / "lens.json").read_text()
    lens.write_text(text.replace('"width": 640', '"width": 1280'))
    assert "set the camera to that resolution" in error_of(capsys, table, "--intrinsics", lens, *out)


def test_nothing_to_do_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert "--print-marker" in error_of(capsys, "--out", tmp_path / "camera.json")
    assert "end the file's name in .png or .pdf" in error_of(capsys, "--print-marker", tmp_path / "board.jpg")
