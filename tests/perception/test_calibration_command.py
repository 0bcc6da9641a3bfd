"""`pixel2catch calibrate` on rendered images of the board in the hand, and the images that it takes."""

import csv
from collections.abc import Sequence
from itertools import count, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from calibration_views import board_in_camera, memory_network, poses, rendered

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.camera.image import Image
from pixel2catch.cli.main import main
from pixel2catch.perception.calibration import capture as capture_module
from pixel2catch.perception.calibration.capture import Capture, blur
from pixel2catch.perception.calibration.lens import SQUARE, CharucoBoard, read_image
from pixel2catch.robots.ur5e import ARM
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.workcells import find_workcell

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


def write_table(path: Path, rows: list[list], names: Sequence[str] = ("image", *JOINTS)) -> Path:
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([names, *rows])
    return path


def read_rows(folder: Path) -> list[list]:
    """Rows of the table, with whole paths of the images."""
    with open(folder / "views.csv", newline="", encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    return [[str(folder / name), *map(float, positions)] for name, *positions in rows]


def test_finds_the_camera_that_took_the_images(laboratory: Path, tmp_path: Path, capsys, refusal: Any):
    out = tmp_path / "new" / "camera.json"
    args = [laboratory / "views.csv", "--intrinsics", laboratory / "lens.json", "--out", out]
    assert main(["calibrate", *map(str, args)]) == 0
    printed = capsys.readouterr()
    assert "no board found in 1 of 9 images: blank.png" in printed.err
    for words in ("Reprojection error: 0.", "worst image", "within the noise of 5 px", "cm behind, 0.0"):
        assert words in printed.out
    found = CameraFile.load(out)
    assert np.linalg.norm(np.subtract(found.camera.pos, RGB_CAMERA.pos)) < 5e-3
    assert max(found.pose_std[:3]) < 5e-3
    assert "exists" in refusal("calibrate", *args)
    assert CameraFile.load(out) == found


def test_the_printed_squares_have_their_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: Any):
    """At 300 dots an inch; the board is found on the page itself, which is not overwritten.

    A camera file that is there is not in the way.
    """
    monkeypatch.chdir(tmp_path)
    assert "--print-marker" in refusal("calibrate")  # nothing to do
    Path("camera.json").touch()
    path = tmp_path / "board.png"
    assert main(["calibrate", "--print-marker", str(path)]) == 0
    view = CharucoBoard().find(read_image(path))
    assert view is not None
    edge = 1e-3 * 25.4 / 300 * np.linalg.norm(view.pixels[1] - view.pixels[0])
    assert edge == pytest.approx(SQUARE, rel=2e-3)
    for name, words in (("board.png", "exists"), ("board.jpg", "end the file's name in .png or .pdf")):
        assert words in refusal("calibrate", "--print-marker", tmp_path / name)


def test_tables_and_images_that_cannot_be_are_refused(laboratory: Path, tmp_path: Path, refusal: Any):
    rows = read_rows(laboratory)
    lens = ("--intrinsics", laboratory / "lens.json", "--out", tmp_path / "camera.json")
    degrees = [[name, *np.degrees(positions)] for name, *positions in rows]
    small, wide = tmp_path / "small.png", tmp_path / "wide.json"
    cv2.imwrite(str(small), np.zeros((240, 320, 3), dtype=np.uint8))
    wide.write_text((laboratory / "lens.json").read_text().replace('"width": 640', '"width": 1280'))
    cases = {
        "no column image": (rows, ["picture", *JOINTS]),
        "no column wrist_3_joint": (rows, ["image", *JOINTS[:5], "wrist_4_joint"]),
        "line 3: 6 columns instead of 7": ([rows[0], rows[1][:-1]],),
        "(240, 320, 3)": ([[small, *rows[0][1:]]] * 6,),
        "if the file is in degrees, convert it": (degrees,),
        "5 images show the board in the hand, 6 are needed": (rows[:5],),
        "nowhere.png'. Correct its name, or leave it out": ([["nowhere.png", *rows[0][1:]], *rows],),
    }
    for words, table in cases.items():
        assert words in refusal("calibrate", write_table(tmp_path / "views.csv", *table), *lens)
    names = find_workcell("fr3_allegro").joint_names[:7]
    other = write_table(tmp_path / "views.csv", [["nowhere.png", *[0.0] * 7]] * 6, ["image", *names])
    assert "nowhere.png" in refusal("calibrate", other, "--workcell", "fr3_allegro", *lens)
    lens = ("--intrinsics", wide, "--out", tmp_path / "camera.json")
    assert "set the camera to it and record again" in refusal("calibrate", laboratory / "views.csv", *lens)
    assert not (tmp_path / "camera.json").exists()


def image_of(joint_pos: np.ndarray, seed: int = 0) -> np.ndarray:
    return cv2.cvtColor(rendered(board_in_camera(joint_pos), np.random.default_rng(seed)), cv2.COLOR_BGR2RGB)


@pytest.fixture(scope="module")
def pose() -> np.ndarray:
    return list(poses(4, seed=2))[3]  # a near one


@pytest.fixture(scope="module")
def picture(pose: np.ndarray) -> np.ndarray:
    return image_of(pose)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    return Capture(tmp_path / "views", CharucoBoard(), JOINTS)


TIMES = count(0.1, 0.1)


def show(capture: Capture, pixels: np.ndarray, joint_pos: np.ndarray | None, number: int = 5) -> list[str]:
    """Show an image as often as that, 0.1 s apart."""
    times = islice(TIMES, number)
    return [capture.look(Image(pixels=pixels, stamp=time, joint_pos=joint_pos)) for time in times]


def test_a_still_view_is_taken_once(capture: Capture, tmp_path: Path, pose: np.ndarray, picture: np.ndarray):
    said = show(capture, picture, pose)
    assert said[0] == "hold still"
    assert said[3] == "1 of 15: wrote pose01.png"
    assert said[4].startswith("like pose01.png")
    with open(tmp_path / "views" / "views.csv", newline="", encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert [float(row[joint]) for joint in JOINTS] == pose.tolist()
    assert np.array_equal(read_image(tmp_path / "views" / row["image"]), picture)


def test_an_unsuitable_image_is_refused_with_a_reason(
    capture: Capture, pose: np.ndarray, picture: np.ndarray
):
    assert show(capture, np.full_like(picture, 90), pose)[-1].startswith("no board: show all of it")
    assert show(capture, picture, None)[-1].startswith("no positions of the arm's joints")
    assert show(capture, cv2.GaussianBlur(picture, (0, 0), 1.4), pose)[-1].startswith("blurred (")
    show(capture, np.full_like(picture, 90), pose)
    moving = [show(capture, picture, pose + 2e-3 * i, number=1)[0] for i in range(8)]
    assert all(words.startswith("hold still") for words in moving)
    assert not capture.taken


@pytest.mark.parametrize("spread", [0.8, 1.4])
def test_blur_is_measured_in_pixels(pose: np.ndarray, picture: np.ndarray, spread: float):
    """The rendered image has a spread of 0.7 px and that of its own pixels; Gaussians add in squares."""
    view = CharucoBoard().find(picture)
    assert view is not None
    sharp = blur(picture, view)
    assert 0.5 < sharp < 1.2
    blurred = blur(cv2.GaussianBlur(picture, (0, 0), spread), view)
    assert blurred == pytest.approx(np.hypot(sharp, spread), rel=0.25)


def test_a_camera_is_calibrated_as_the_arm_moves(tmp_path: Path, monkeypatch, capsys, refusal: Any):
    """The arm holds a pose until its image is there, then the next; after 8 there is nothing more to take."""
    CameraFile(camera=RGB_CAMERA).save(tmp_path / "lens.json")
    shown = [(joint_pos, image_of(joint_pos, i)) for i, joint_pos in enumerate(poses(8, seed=2))]
    monkeypatch.setattr(capture_module, "NUM_VIEWS", 8)
    memory_network(monkeypatch, lambda _: shown[len(list((tmp_path / "views").glob("*.png")))])
    args = ["--live", "--intrinsics", tmp_path / "lens.json", "--capture", tmp_path / "views"]
    assert main(["calibrate", *map(str, args), "--out", str(tmp_path / "camera.json")]) == 0
    printed = capsys.readouterr()
    assert "8 of 8: wrote pose08.png" in printed.err
    assert "By the arm's motion the squares are" in printed.out
    found = CameraFile.load(tmp_path / "camera.json")
    error = np.abs(np.subtract(found.camera.pos, RGB_CAMERA.pos))
    assert (error < 3.0 * np.array(found.pose_std[:3])).all()
    assert "views', which is not an empty" in refusal("calibrate", *args, "--out", tmp_path / "other.json")
