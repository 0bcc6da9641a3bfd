"""The printed board whose corners a calibration finds in images, and the camera's lens.

ROS and OpenCV call the middle of the first pixel (0, 0), this project (0.5, 0.5): what is read is moved.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from pixel2catch.camera.camera_file import LENS_SIZES, CameraFile
from pixel2catch.camera.image import Pixels
from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.files import MOST_YAML, decoded, parse_yaml, read_text, reading, shown
from pixel2catch.perception.sources import connections_of, image_files, read_image
from pixel2catch.ros2.bags import decoded as bag_messages
from pixel2catch.ros2.bags import is_bag, opened_bag
from pixel2catch.ros2.messages import CAMERA_INFO, delivered, lens_fault
from pixel2catch.scene.constants import PIXEL_CENTER, RGB_CAMERA

MIN_CORNERS = 5  #: Fewest for the board's pose: of five, four have no three in a line.

SQUARES = (3, 4)
"""Columns and rows of the board. Source: ours; of the boards that fit on A4 (3 x 4, 4 x 5 and 5 x 7 squares,
rendered at 640 x 480), the one that is found from the farthest, 1.5 m."""

SQUARE = 0.06  #: Edge of a printed square [m].
MARKER_SHARE = 0.75  #: Edge of a marker, as a share of that of its square.
PAGE, PAGE_DPI, MM_PER_INCH = (210.0, 297.0), 300, 25.4  #: A4 [mm].
SQUARE_PIXELS = 480  #: Edge of a square in the picture of the board [px].

LENS_MODELS = ("", "plumb_bob", "rational_polynomial")  #: Of ROS, that OpenCV has; empty: no distortion.
MIN_VIEWS = 10  #: Fewest images of the board for a lens. Source: OpenCV's tutorial.

FOCAL_ERROR = 0.004  #: Relative standard deviation of a focal length that states none. Source: ours.
OWN_FOCAL_ERROR, LARGEST_OWN_ERROR = 0.02, 0.1
"""Smallest and largest relative standard deviation of the focal length by images of the board alone, with the
optical axis in the middle of the image. Source: ours, of simulated views of cameras with the axis 10 px off;
from the largest on, fits in simulation were wrong by more than half of the focal length."""

MIN_TILTED, TILT = 3, np.radians(10.0)  #: Fewest images in which the board is tilted by so much [rad].

DISTORTION_SPREAD = (4.0, 15.0, 0.1, 0.1)
"""Standard deviations of k1, k2, p1, p2 over the relative one of the focal length, which is also that of the
optical axis over the focal length. Source: ours, of fits of a lens to 12 images of the board."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardView:
    """The corners of the board in one image."""

    points: Float[np.ndarray, "num_points 3"]  #: In the board's frame [m].
    pixels: Float[np.ndarray, "num_points 2"]  #: In the image [px].


class CharucoBoard:
    """A chessboard with markers (ChArUco), which identify its corners."""

    def __init__(self, square: float = SQUARE) -> None:
        """Describe the board by the edge of a square as printed [m], less than a metre."""
        if not 0.0 < square < 1.0:
            raise InvalidValueError(f"a square of {square:g} m; give its edge in metres, such as {SQUARE}.")
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        self._board = cv2.aruco.CharucoBoard(SQUARES, square, MARKER_SHARE * square, dictionary)
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def find(self, image: Pixels) -> BoardView | None:
        """Return the corners in an image; None if they do not define the board's pose."""
        corners, ids, _, _ = self._detector.detectBoard(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        points = np.asarray(self._board.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
        pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2) + PIXEL_CENTER
        return BoardView(points=points[np.asarray(ids, dtype=np.int64).ravel()], pixels=pixels)

    def picture(self) -> np.ndarray:
        """Return the board in grey levels."""
        columns, rows = SQUARES
        return self._board.generateImage((columns * SQUARE_PIXELS, rows * SQUARE_PIXELS))


def sheet() -> Figure:
    """Return the page to print: the board in its size on A4."""
    width, height = PAGE
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH), dpi=PAGE_DPI)
    board_width, board_height = (1e3 * SQUARE * number for number in SQUARES)
    place = (0.5 - 0.5 * board_width / width, 0.5 - 0.5 * board_height / height)
    axes = figure.add_axes((*place, board_width / width, board_height / height))
    axes.imshow(CharucoBoard().picture(), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    axes.set_axis_off()
    words = f"Print at 100 %, glue on a stiff plate, measure a square: {1e3 * SQUARE:g} mm? Else: --square."
    figure.text(0.5, 0.5 * place[1], words, ha="center", va="center", fontsize=9)
    return figure


def lens_values(lens: CameraFile) -> Float[np.ndarray, " num_values"]:
    """Return fx, fy, cx, cy [px], then the distortion, at least (k1, k2, p1, p2)."""
    camera = lens.camera
    return np.array((camera.fx, camera.fy, camera.cx, camera.cy, *(lens.distortion or (0.0,) * 4)))


def lens_spread(lens: CameraFile) -> Float[np.ndarray, "num_values num_errors"]:
    """Return how independent errors of one standard deviation change the values of a lens.

    These are of the focal length, the optical axis, and the distortion where there is one.
    """
    values = lens_values(lens)
    error = FOCAL_ERROR if lens.focal_std is None else lens.focal_std
    scales = np.array((0.0, values[0], values[0], *DISTORTION_SPREAD))[: 7 if lens.distortion else 3]
    spread = np.zeros((len(values), len(scales)))
    spread[1 : len(scales) + 1] = np.diag(scales)
    spread[:2, 0] = values[:2]
    return error * spread


def read_lens(
    path: Path, board: CharucoBoard, topic: str | None = None, *, is_rectified: bool = False
) -> CameraFile:
    """Read or compute a lens: a camera whose pose is not that of the laboratory.

    Args:
        path: A file of `camera_calibration` or `ros2 topic echo` (.yaml), a camera file (.json), a rosbag2
            with a CameraInfo, or a folder with images of the board.
        board: The board in these images.
        topic: Of the CameraInfo; None for the only one.
        is_rectified: Whether images are rectified; then the projection matrix is the lens.

    Raises PerceptionError if it cannot be read or OpenCV does not have this lens model.
    """
    if path.suffix == ".json":
        return CameraFile.load(path)
    if path.suffix in (".yaml", ".yml"):
        return _of_camera_info(path, _of_yaml(path), is_rectified)
    if is_bag(path):
        with opened_bag(path) as reader:
            chosen = connections_of(path, reader.connections, [CAMERA_INFO], topic)
            info = next(bag_messages(reader, chosen)).content
        return _of_camera_info(path, info, is_rectified)
    if path.is_dir():
        return lens_of_images(path, board)
    raise PerceptionError(
        f"{path}: not there, or of no known kind; give a .yaml of camera_calibration, a rosbag2, a camera "
        "file (.json), or a folder with images of the board."
    )


def lens_of_images(folder: Path, board: CharucoBoard) -> CameraFile:
    """Compute a lens (k1, k2, p1, p2) from images of the board."""
    paths = image_files(folder)
    sizes, views = set[tuple[int, int]](), list[BoardView]()
    for image in map(read_image, paths):
        sizes.add((image.shape[1], image.shape[0]))
        views += [view] if (view := board.find(image)) else []
    if len(views) < MIN_VIEWS:
        raise PerceptionError(
            f"{folder}: {len(views)} of {len(paths)} images show the whole board; {MIN_VIEWS} are needed. "
            "Hold it nearer and in the light."
        )
    if len(sizes) > 1:
        raise PerceptionError(f"{folder}: images of sizes {sorted(sizes)}; keep those of one resolution.")
    return lens_of_views(folder, views, sizes.pop())


def lens_of_views(where: Path, views: Sequence[BoardView], size: tuple[int, int]) -> CameraFile:
    """Compute a lens from views of the board in images of this width and height [px].

    Raises PerceptionError with `where` they are from, if they do not tell the focal length.
    """
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    fixed = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST
    _, matrix, distortion, turns, _, deviations, *_ = cv2.calibrateCameraExtended(
        points, pixels, size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3 | fixed
    )
    focal_std = max(float(deviations[1, 0] / matrix[1, 1]), OWN_FOCAL_ERROR)
    num_tilted = sum(cv2.Rodrigues(turn)[0][2, 2] < np.cos(TILT) for turn in turns)
    if num_tilted < MIN_TILTED or focal_std > LARGEST_OWN_ERROR:
        raise PerceptionError(
            f"{where}: the images do not tell the focal length, because the board is tilted too little: add "
            "images of it tilted by 20 to 40° in all directions, or give a calibrated lens by --intrinsics."
        )
    return replace(_lens(size, matrix, distortion.ravel()[:4]), focal_std=focal_std)


def _lens(size: tuple[int, int], matrix: np.ndarray, distortion: Iterable[float]) -> CameraFile:
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    camera = replace(RGB_CAMERA, width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy)
    return CameraFile(camera=camera, distortion=tuple(map(float, distortion)))


def _of_camera_info(path: Path, info: Any, is_rectified: bool) -> CameraFile:
    if info.distortion_model not in LENS_MODELS or len(info.d) not in LENS_SIZES:
        raise PerceptionError(
            f"{path}: lens model {shown(info.distortion_model)} with {len(info.d)} numbers is not read; "
            "record rectified images and give --rectified, or calibrate with plumb_bob."
        )
    flat, count = (info.p, 12) if is_rectified else (info.k, 9)
    flat = np.array(flat if len(flat) == count else np.zeros(count), dtype=np.float64)
    if fault := lens_fault(info, flat):
        raise PerceptionError(f"{path}: {fault}")
    width, height, matrix = delivered(info, flat)
    return _lens((width, height), matrix, () if is_rectified else info.d)


def _of_yaml(path: Path) -> SimpleNamespace:
    """The content of a file of `camera_calibration` or `ros2 topic echo`, by the names of a CameraInfo."""
    names = {"k": "camera_matrix", "d": "distortion_coefficients", "p": "projection_matrix"}
    fix = f"It needs image_width, image_height, distortion_model, {', '.join(names.values())}; give these "
    fix += "also for a file that OpenCV wrote (%YAML:1.0), as camera_calibration writes them."
    with reading("file of camera_calibration", path, fix, PerceptionError):
        content = parse_yaml(read_text(path, MOST_YAML).strip().removeprefix("---").partition("\n---")[0])
        found = {"roi": {}, "binning_x": 0, "binning_y": 0, **content}
        found |= {name: content.get(f"image_{name}", content.get(name)) for name in ("width", "height")}
        numbers = {
            name: decoded(int, found[name], name) for name in ("width", "height", "binning_x", "binning_y")
        }
        region = dict.fromkeys(("x_offset", "y_offset", "width", "height"), 0)
        region |= decoded(dict[str, int | bool], found["roi"], "roi")
        lists = {
            short: decoded(tuple[float, ...], content[short] if short in content else content[name]["data"])
            for short, name in names.items()
        }
        model = decoded(str, content["distortion_model"], "distortion_model")
    return SimpleNamespace(distortion_model=model, roi=SimpleNamespace(**region), **numbers, **lists)
