"""The camera's lens: from ROS, from a file, or from images of the printed board.

ROS and OpenCV call the middle of the first pixel (0, 0), this project (0.5, 0.5): what is read is moved.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from pixel2catch.camera.camera_file import LENS_SIZES, CameraFile
from pixel2catch.errors import PerceptionError
from pixel2catch.files import MOST_YAML, decoded, parse_yaml, read_text, reading, shown
from pixel2catch.perception.bag_images import first_camera_info
from pixel2catch.perception.calibration.target import BoardView, CharucoBoard, read_image
from pixel2catch.ros2.bags import is_bag
from pixel2catch.scene.constants import PIXEL_CENTER

LENS_MODELS = ("", "plumb_bob", "rational_polynomial")
"""Lens models of ROS that OpenCV has; an empty name is no distortion."""

MIN_VIEWS = 10  #: Fewest images of the board for a lens. Source: OpenCV's tutorial.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True, kw_only=True, eq=False)
class Intrinsics:
    """A lens: a pinhole and its distortion."""

    size: tuple[int, int]  #: Width and height of the image [px].
    matrix: Float[np.ndarray, "3 3"]  #: Focal lengths and optical axis [px].
    distortion: tuple[float, ...] = ()  #: As in OpenCV; empty for rectified images.
    focal_std: float | None = None  #: Standard deviation, relative to the focal length; None if unknown.
    rms: float | None = None  #: RMS distance of seen and computed corners [px]; None if not measured here.

    def undistorted(self, pixels: Float[np.ndarray, "num_points 2"]) -> Float[np.ndarray, "num_points 2"]:
        """Return where a pinhole would see what the lens sees at these places [px]."""
        if not any(self.distortion):
            return pixels
        lens = np.array(self.distortion)
        return cv2.undistortPoints(pixels[:, None], self.matrix, lens, P=self.matrix).reshape(-1, 2)


def read_intrinsics(
    path: Path, board: CharucoBoard, topic: str | None = None, *, is_rectified: bool = False
) -> Intrinsics:
    """Read or compute a lens.

    Args:
        path: A file of `camera_calibration` (.yaml), a camera file (.json), a rosbag2 with a CameraInfo, or a
            folder with images of the board.
        board: The board in these images.
        topic: Of the CameraInfo; None for the only one.
        is_rectified: Whether images are rectified; then the projection matrix is the lens.

    Raises:
        PerceptionError: It cannot be read, OpenCV does not have this lens model, or too few images show the
            board.
        InvalidValueError: A camera file is damaged.
    """
    if path.suffix == ".json":
        known = CameraFile.load(path)
        camera = known.camera
        return Intrinsics(
            size=(camera.width, camera.height),
            matrix=np.array(camera.matrix),
            distortion=known.distortion,
            focal_std=known.focal_std,
        )
    if path.suffix in (".yaml", ".yml"):
        return _of_camera_info(path, _of_yaml(path), is_rectified)
    if is_bag(path):
        return _of_camera_info(path, first_camera_info(path, topic), is_rectified)
    if path.is_dir():
        return intrinsics_of_images(path, board)
    raise PerceptionError(
        f"{path}: not there, or of no known kind; give a .yaml of camera_calibration, a rosbag2, a camera "
        "file (.json), or a folder with images of the board."
    )


def intrinsics_of_images(folder: Path, board: CharucoBoard) -> Intrinsics:
    """Compute a lens from images of the board.

    Raises:
        PerceptionError: Too few images show it, or their sizes differ.
    """
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    sizes, views = set[tuple[int, int]](), list[BoardView]()
    for image in map(read_image, paths):
        sizes.add((image.shape[1], image.shape[0]))
        if view := board.find(image):
            views.append(view)
    if len(views) < MIN_VIEWS:
        raise PerceptionError(
            f"{folder}: {len(views)} of {len(paths)} images show the whole board; {MIN_VIEWS} are needed. "
            "Hold it nearer and in the light."
        )
    if len(sizes) > 1:
        raise PerceptionError(f"{folder}: images of sizes {sorted(sizes)}; keep those of one resolution.")
    return intrinsics_of_views(views, sizes.pop())


def intrinsics_of_views(views: Sequence[BoardView], size: tuple[int, int]) -> Intrinsics:
    """Compute a lens (k1, k2, p1, p2) from the corners of a board in several images of a size [px]."""
    rms, matrix, lens, _, _, deviations, *_ = cv2.calibrateCameraExtended(
        [view.points.astype(np.float32) for view in views],
        [view.pixels.astype(np.float32)[:, None] for view in views],
        size,
        np.eye(3),
        np.zeros(5),
        flags=cv2.CALIB_FIX_K3,
    )
    return Intrinsics(
        size=size,
        matrix=matrix,
        distortion=tuple(map(float, lens.ravel()[:4])),
        focal_std=float(deviations[0, 0] / matrix[0, 0]),
        rms=float(rms),
    )


def _of_camera_info(path: Path, info: Any, is_rectified: bool) -> Intrinsics:
    """The lens of a CameraInfo of ROS, in this project's image coordinates."""
    if info.distortion_model not in LENS_MODELS or len(info.d) not in LENS_SIZES:
        raise PerceptionError(
            f"{path}: lens model {shown(info.distortion_model)} with {len(info.d)} numbers is not read; "
            "record rectified images and give --rectified, or calibrate with plumb_bob."
        )
    flat, columns = (info.p, 4) if is_rectified else (info.k, 3)
    matrix = np.array(flat, dtype=np.float64)
    matrix = matrix.reshape(3, columns)[:, :3] if len(matrix) == 3 * columns else np.zeros((3, 3))
    size = (int(info.width), int(info.height))
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0.0 or matrix[1, 1] <= 0.0 or min(size) <= 0:
        raise PerceptionError(f"{path}: no focal length or image size; the camera is not calibrated yet.")
    matrix[:2, 2] += PIXEL_CENTER
    lens = () if is_rectified else tuple(map(float, info.d))
    return Intrinsics(size=size, matrix=matrix, distortion=lens)


def _of_yaml(path: Path) -> SimpleNamespace:
    """The content of a file of `camera_calibration`, by the names of a CameraInfo."""
    names = {"k": "camera_matrix", "d": "distortion_coefficients", "p": "projection_matrix"}
    fix = f"It needs image_width, image_height, distortion_model, {', '.join(names.values())}."
    with reading("file of camera_calibration", path, fix, PerceptionError):
        content = parse_yaml(read_text(path, MOST_YAML))
        lists = {
            short: decoded(tuple[float, ...], content[name]["data"], name) for short, name in names.items()
        }
        width, height = (decoded(int, content[name], name) for name in ("image_width", "image_height"))
        model = decoded(str, content["distortion_model"], "distortion_model")
    return SimpleNamespace(width=width, height=height, distortion_model=model, **lists)
