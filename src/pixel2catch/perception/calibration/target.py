"""Boards whose corners a calibration finds in images: one to print for the hand, and any chessboard."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from pixel2catch.camera.image import Pixels
from pixel2catch.errors import InvalidValueError, PerceptionError
from pixel2catch.files import read_bytes, reading
from pixel2catch.ros2.messages import MOST_PIXELS, unpacked_image
from pixel2catch.scene.constants import PIXEL_CENTER

MIN_CORNERS = 5
"""Corners of the printed board that tell its pose: four, no three of which are in a line, are among them."""

SQUARES = (3, 4)
"""Columns and rows of the printed board. Source: ours; of the boards tried that fit on A4 (3 x 4, 4 x 5 and
5 x 7 squares, rendered at 640 x 480), the one that is found from the farthest, 1.5 m."""

SQUARE = 0.06  #: Edge of a printed square [m].
MARKER_SHARE = 0.75  #: Edge of a marker over that of its square.
PAGE, PAGE_DPI, MM_PER_INCH = (210.0, 297.0), 300, 25.4  #: A4 [mm].
SQUARE_PIXELS = 480
MOST_IMAGE = 2**27  #: Bytes of an image file. Source: ours.


@dataclass(frozen=True, kw_only=True)
class View:
    """What one image shows of a board."""

    points: Float[np.ndarray, "num_points 3"]  #: Corners in the board's frame [m], else [squares].
    pixels: Float[np.ndarray, "num_points 2"]  #: Where they are in the image [px].


class Board(ABC):
    """A flat board with corners at known places."""

    @abstractmethod
    def find(self, image: Pixels) -> View | None:
        """Return the corners in an image; None where they do not tell the board's pose."""


class CharucoBoard(Board):
    """The printed board: a chessboard with markers (ChArUco), so that corners are told from each other."""

    def __init__(self, square: float = SQUARE) -> None:
        """Describe the board by the edge of a square as printed [m].

        Raises:
            InvalidValueError: If it is not positive.
        """
        if not 0.0 < square < 1.0:
            raise InvalidValueError(f"a square of {square:g} m; give its edge in metres, such as {SQUARE}.")
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        self._board = cv2.aruco.CharucoBoard(SQUARES, square, MARKER_SHARE * square, dictionary)
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def find(self, image: Pixels) -> View | None:
        """See `Board.find`."""
        corners, ids, _, _ = self._detector.detectBoard(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        points = np.asarray(self._board.getChessboardCorners(), dtype=np.float64)
        return _view(points[np.asarray(ids, dtype=np.int64).ravel()], corners)

    def picture(self) -> np.ndarray:
        """The board in grey levels."""
        columns, rows = SQUARES
        return self._board.generateImage((columns * SQUARE_PIXELS, rows * SQUARE_PIXELS))


class Chessboard(Board):
    """A chessboard, for a lens only: it looks the same if turned by 180°, and a square is taken for 1."""

    def __init__(self, corners: tuple[int, int]) -> None:
        """Describe the board by columns and rows of inner corners.

        Raises:
            InvalidValueError: If there are too few corners.
        """
        if min(corners) < 3:
            raise InvalidValueError(f"a chessboard of {corners} inner corners; both must be 3 or more.")
        self._corners = corners
        row, column = np.indices(corners[::-1])
        self._points = np.stack((column, row, 0 * row), axis=-1).reshape(-1, 3).astype(np.float64)

    def find(self, image: Pixels) -> View | None:
        """See `Board.find`; all corners or none."""
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        is_found, pixels = cv2.findChessboardCornersSB(gray, self._corners, flags=cv2.CALIB_CB_ACCURACY)
        return _view(self._points, pixels) if is_found else None


def read_image(path: Path) -> Pixels:
    """Read an image file.

    Raises:
        PerceptionError: If it is missing or no image.
    """
    with reading("image", path, "Correct its name, or leave it out.", PerceptionError):
        pixels = unpacked_image(read_bytes(path, MOST_IMAGE))
        if pixels is None:
            raise PerceptionError(f"not a readable image of {MOST_PIXELS:,} pixels at most")
    return pixels


def sheet() -> Figure:
    """The page to print: the board in its size on A4."""
    width, height = PAGE
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH), dpi=PAGE_DPI)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    board_width, board_height = (1e3 * SQUARE * number for number in SQUARES)
    left, bottom = 0.5 * (width - board_width), 0.5 * (height - board_height)
    extent = (left, left + board_width, bottom, bottom + board_height)
    look = {"cmap": "gray", "vmin": 0, "vmax": 255, "interpolation": "nearest"}
    axes.imshow(CharucoBoard().picture(), extent=extent, **look)
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    axes.set_axis_off()
    axes.text(
        0.5 * width,
        0.5 * bottom,
        f"Print at 100 %, glue on a stiff plate, measure a square: {1e3 * SQUARE:g} mm? Else: --square.",
        ha="center",
        va="center",
        fontsize=9,
    )
    return figure


def _view(points: np.ndarray, pixels: np.ndarray) -> View:
    """Corners as OpenCV returns them, in double precision and in our image coordinates."""
    return View(
        points=np.asarray(points, dtype=np.float64).reshape(-1, 3),
        pixels=np.asarray(pixels, dtype=np.float64).reshape(-1, 2) + PIXEL_CENTER,
    )
