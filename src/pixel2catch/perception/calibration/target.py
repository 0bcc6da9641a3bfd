"""The printed board whose corners a calibration finds in images."""

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
"""Fewest corners that define the board's pose. Of five, four are such that no three of them are in a line."""

SQUARES = (3, 4)
"""Columns and rows of the board. Source: ours; of the boards that fit on A4 (3 x 4, 4 x 5 and 5 x 7 squares,
rendered at 640 x 480), the one that is found from the farthest, 1.5 m."""

SQUARE = 0.06  #: Edge of a printed square [m].
MARKER_SHARE = 0.75  #: Edge of a marker, as a share of that of its square.
PAGE, PAGE_DPI, MM_PER_INCH = (210.0, 297.0), 300, 25.4  #: A4 [mm].
SQUARE_PIXELS = 480  #: Edge of a square in the picture of the board [px].
MOST_IMAGE = 2**27  #: Largest image file [bytes]. Source: ours.


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardView:
    """The corners of the board in one image."""

    points: Float[np.ndarray, "num_points 3"]  #: In the board's frame [m].
    pixels: Float[np.ndarray, "num_points 2"]  #: In the image [px].


class CharucoBoard:
    """A chessboard with markers (ChArUco), which identify its corners."""

    def __init__(self, square: float = SQUARE) -> None:
        """Describe the board by the edge of a square as printed [m].

        Raises:
            InvalidValueError: It is not positive, or a metre or more.
        """
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


def read_image(path: Path) -> Pixels:
    """Read an image file.

    Raises:
        PerceptionError: It is missing or no image.
    """
    with reading("image", path, "Correct its name, or leave it out.", PerceptionError):
        pixels = unpacked_image(read_bytes(path, MOST_IMAGE))
        if pixels is None:
            raise PerceptionError(f"not a readable image of {MOST_PIXELS:,} pixels at most")
    return pixels


def sheet() -> Figure:
    """Return the page to print: the board in its size on A4."""
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
    words = f"Print at 100 %, glue on a stiff plate, measure a square: {1e3 * SQUARE:g} mm? Else: --square."
    axes.text(0.5 * width, 0.5 * bottom, words, ha="center", va="center", fontsize=9)
    return figure
