"""The lens from ROS, from files and from images of boards."""

from dataclasses import replace
from math import nan
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from calibration_views import CORNERS, lens, near_views, rendered
from scipy.spatial.transform import Rotation

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.perception.calibration.lens import (
    CharucoBoard,
    lens_of_images,
    lens_of_views,
    lens_spread,
    lens_values,
    read_image,
    read_lens,
)
from pixel2catch.ros2.messages import CAMERA_INFO, STORE, read_camera_info
from pixel2catch.scene.constants import RGB_CAMERA
from ros_bags import TYPES, header, save_bag

YAML = """image_width: 640
image_height: 480
camera_matrix: {data: [618.1, 0., 327.9, 0., 618.4, 246., 0., 0., 1.]}
distortion_model: plumb_bob
distortion_coefficients: {data: [0.1, -0.2, 0.001, 0.002, 0.0]}
projection_matrix: {data: [610., 0., 320., 0., 0., 611., 240., 0., 0., 0., 1., 0.]}
"""
"""What is read of a file of `camera_calibration`."""

BOARD = CharucoBoard()


def board_pose(rng: np.random.Generator) -> np.ndarray:
    """A board near the camera, turned about any axis."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
    middle = np.array((*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.5, 0.7)))
    pose[:3, 3] = middle - pose[:3, :3] @ CORNERS.mean(axis=0)
    return pose


def camera_info(distortion: tuple[float, ...], binning: int, region: tuple[int, ...]) -> Any:
    k = np.array((618.1, 0, 327.9, 0, 618.4, 246.0, 0, 0, 1))
    p = np.array((610.0, 0, 320, 0, 0, 611, 240, 0, 0, 0, 1, 0))
    numbers = (np.array(distortion), k, np.eye(3).ravel(), p)
    roi, model = TYPES["sensor_msgs/msg/RegionOfInterest"](*region, False), "plumb_bob" if distortion else ""
    return TYPES["sensor_msgs/msg/CameraInfo"](header(1), 480, 640, model, *numbers, binning, binning, roi)


def write_bag(path: Path, *topics: str) -> Path:
    """The same lens as a CameraInfo on several topics."""
    info = camera_info((0.1, -0.2, 0.001, 0.002, 0.0), 0, (0, 0, 0, 0))
    return save_bag(path, [(topic, 1, info) for topic in topics])


@pytest.mark.parametrize(
    ("binning", "region", "size", "center"),
    [
        (0, (0, 0, 0, 0), (640, 480), (328.4, 246.5)),
        (1, (100, 40, 400, 500), (500, 400), (228.4, 206.5)),
        (2, (100, 40, 400, 500), (250, 200), (114.2, 103.25)),
    ],
)
def test_a_lens_is_cut_and_binned_as_its_images(
    binning: int, region: tuple[int, ...], size: tuple[int, int], center: tuple[float, float], tmp_path: Path
):
    """Offsets x and y, height and width; no distortion; from the network and `ros2 topic echo`."""
    info, path = camera_info((), binning, region), tmp_path / "info.yaml"
    sizes, places = ("width", "height"), ("x_offset", "y_offset")
    shown = {name: getattr(info, name) for name in (*sizes, "distortion_model", "binning_x", "binning_y")}
    shown |= {name: getattr(info, name).tolist() for name in "dkp"}
    shown["roi"] = {name: getattr(info.roi, name) for name in (*places, *sizes)}
    path.write_text(f"{shown}\n---\n{shown}")
    data = bytes(STORE.serialize_cdr(info, CAMERA_INFO))
    for camera in (read_lens(path, BOARD).camera, read_camera_info(data)):
        assert (camera.width, camera.height) == size
        assert (camera.cx, camera.cy) == pytest.approx(center)
        assert camera.fx == pytest.approx(618.1 / max(binning, 1))


def check_lens(found: CameraFile) -> None:
    """The middle of the first pixel is (0, 0) for ROS and (0.5, 0.5) here."""
    assert (found.camera.width, found.camera.height) == (640, 480)
    np.testing.assert_allclose(found.camera.matrix, ((618.1, 0, 328.4), (0, 618.4, 246.5), (0, 0, 1)))
    assert found.distortion == (0.1, -0.2, 0.001, 0.002, 0.0)


def test_reads_the_lens_of_a_file_and_of_a_bag_rectified_or_not(tmp_path: Path):
    (tmp_path / "ost.yaml").write_text(YAML)
    for path in (tmp_path / "ost.yaml", write_bag(tmp_path / "bag", "/camera_info")):
        check_lens(read_lens(path, BOARD))
        read_lens(path, BOARD).save(tmp_path / "camera.json")
        check_lens(read_lens(tmp_path / "camera.json", BOARD))
        found = read_lens(path, BOARD, is_rectified=True)
        np.testing.assert_allclose(found.camera.matrix, ((610, 0, 320.5), (0, 611, 240.5), (0, 0, 1)))
        assert found.distortion == ()


@pytest.mark.parametrize("tilt", [0.0, 0.05, 0.1])
def test_a_board_that_is_not_tilted_does_not_tell_the_focal_length(tilt: float):
    """Focal length and distance change such images in the same way."""
    views = near_views(np.random.default_rng(2), 12, lens(), tilt)
    with pytest.raises(PerceptionError, match=r"views: .* do not tell the focal length.*tilted by 20"):
        lens_of_views(Path("views"), views, (640, 480))


def test_a_lens_is_spread_by_its_focal_length():
    """By 1 %: the axis by 1 % of the focal length; the distortion only where there is one."""
    given = replace(lens((0.1, 0.0, 0.0, 0.0)), focal_std=0.01)
    spread, fx, fy = lens_spread(given), RGB_CAMERA.fx, RGB_CAMERA.fy
    assert spread[:, 0] == pytest.approx((0.01 * fx, 0.01 * fy, 0, 0, 0, 0, 0, 0))
    assert spread[:, 1] == pytest.approx((0, 0, 0.01 * fx, 0, 0, 0, 0, 0))
    assert spread[:, 3] == pytest.approx((0, 0, 0, 0, 0.04, 0, 0, 0))
    assert lens_spread(replace(given, distortion=())).shape == (8, 3)
    assert not lens_spread(replace(given, focal_std=0.0)).any()
    assert lens_values(given)[:4] == pytest.approx((fx, fy, RGB_CAMERA.cx, RGB_CAMERA.cy))


def test_computes_a_lens_from_images_of_the_printed_board(tmp_path: Path):
    rng = np.random.default_rng(5)
    for i in range(10):
        cv2.imwrite(str(tmp_path / f"{i}.png"), rendered(board_pose(rng), rng, magnification=2))
    found = lens_of_images(tmp_path, BOARD)
    camera = found.camera
    assert found.focal_std is not None
    assert abs(camera.fx / RGB_CAMERA.fx - 1) < 2 * found.focal_std < 0.1
    assert camera.fy == camera.fx
    assert (camera.cx, camera.cy) == (319.5, 239.5)  # OpenCV's middle of the image
    (tmp_path / "9.png").unlink()
    with pytest.raises(PerceptionError, match=r"9 of 9 images show the whole board; 10 are needed"):
        lens_of_images(tmp_path, BOARD)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("%YAML:1.0\n---\n" + YAML, r"also for a file that OpenCV wrote \(%YAML:1.0\)"),
        (YAML.replace("618.1", "6e9"), r"6e\+09 x 618.4 px .* are not of images of 640 x 480"),
        ("header: 1\nk: [1.0]\n", "cannot read the file of camera_calibration .* It needs image_width"),
        (YAML.replace("618.1", "0.0"), "not calibrated yet"),
        (YAML.replace("618.1", "0.6"), r"0.6 x 618.4 px .* are not of images of 640 x 480"),
        (YAML.replace("327.9", "3279."), r"optical axis at \(3279, 246\) px are not"),
        (YAML.replace("[618.1, 0.,", "[618.1, 2.,"), "the skew 2"),
        (YAML + "roi: {x_offset: 300, y_offset: 0, width: 400, height: 400}", "is not within its image"),
        (YAML + "roi: {x_offset: -8, y_offset: 0, width: 400, height: 400}", "is not within its image"),
        (YAML.replace("plumb_bob", "equidistant"), "'equidistant'.*--rectified"),
    ],
)
def test_a_file_without_a_lens_is_refused(tmp_path: Path, text: str, words: str):
    (tmp_path / "ost.yaml").write_text(text)
    with pytest.raises(PerceptionError, match=words):
        read_lens(tmp_path / "ost.yaml", BOARD)


def test_a_bag_without_the_topic_is_refused(tmp_path: Path):
    two = write_bag(tmp_path / "two", "/left/camera_info", "/right/camera_info")
    check_lens(read_lens(two, BOARD, "/left/camera_info"))
    for topic in (None, "/rgb"):
        with pytest.raises(PerceptionError, match=r"on /left/camera_info, /right/camera_info; .* --topic"):
            read_lens(two, BOARD, topic)


def test_other_paths_are_refused(tmp_path: Path):
    with pytest.raises(PerceptionError, match="not there, or of no known kind"):
        read_lens(tmp_path / "nothing", BOARD)
    with pytest.raises(PerceptionError, match="0 of 0 images"):
        read_lens(tmp_path, BOARD)
    with pytest.raises(PerceptionError, match="cannot read the image"):
        read_image(tmp_path / "missing.png")


@pytest.mark.parametrize("square", [0.0, 60.0, nan])
def test_a_square_is_in_metres(square: float):
    with pytest.raises(InvalidValueError, match=r"in metres, such as 0\.06"):
        CharucoBoard(square)
