"""Video files and animations, and the box of the policy in a picture."""

from collections.abc import Iterable
from contextlib import AbstractContextManager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image

from pixel2catch.errors import InvalidValueError

WEBP_QUALITY, WEBP_EFFORT = 60, 4  #: Of 100, and of 6.
BOX_COLOR = (80, 255, 80)
BOX_WIDTH = 2  #: Width of a drawn box's edge [px].
FORMATS = (".mp4", ".webp", ".gif", ".png")  #: Endings of the files of a film; a PNG has stills.


def write_film(path: Path, pictures: Iterable[UInt8[ndarray, "height width 3"]], fps: int) -> int:
    """Write pictures as a video or a repeating animation, by the file's ending; return their number."""
    if path.suffix.lower() == ".mp4":
        with VideoWriter(path, fps=fps) as video:
            return sum(1 for _ in map(video.write, pictures))
    first, *others = (Image.fromarray(picture) for picture in pictures)
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=1000 // fps,
        loop=0,
        quality=WEBP_QUALITY,
        method=WEBP_EFFORT,
    )
    return 1 + len(others)


def draw_box(image: UInt8[ndarray, "height width 3"], box: Float[ndarray, "4"]) -> None:
    """Draw the edges of a box (xmin, ymin, xmax, ymax [px]) and its middle into an image."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = (round(float(value)) for value in box)
    x, y = (x0 + x1) // 2, (y0 + y1) // 2
    e = BOX_WIDTH
    outline = ((x0, y0, x1, y0 + e), (x0, y1 - e, x1, y1), (x0, y0, x0 + e, y1), (x1 - e, y0, x1, y1))
    for left, top, right, bottom in (*outline, (x - e, y - e, x + e, y + e)):
        rows = slice(max(top, 0), min(max(bottom, 0), height))
        columns = slice(max(left, 0), min(max(right, 0), width))
        image[rows, columns] = BOX_COLOR


class VideoWriter(AbstractContextManager["VideoWriter"]):
    """Writes pictures of one size to an H.264 file; a context manager."""

    def __init__(self, path: Path, *, fps: int = 30, crf: int = 23) -> None:
        """Open the file; its ending names the container, such as .mp4.

        Args:
            path: The file.
            fps: Pictures per second.
            crf: Constant rate factor; a lower one is better and gives a larger file.

        Raises:
            InvalidValueError: The folder does not exist, or the ending names no format.
        """
        if not path.parent.is_dir():
            raise InvalidValueError(f"cannot write '{path}': there is no folder '{path.parent}'.")
        try:
            self._container = av.open(str(path), "w")
        except ValueError as error:
            raise InvalidValueError(f"cannot write '{path}': {error}; end its name in .mp4.") from error
        options = {"crf": str(crf)}
        self._stream: Any = self._container.add_stream("libx264", rate=Fraction(fps), options=options)
        self._stream.pix_fmt = "yuv420p"
        self._is_sized = False

    def write(self, image: UInt8[np.ndarray, "height width 3"]) -> None:
        """Append one picture (red, green, blue).

        Raises:
            InvalidValueError: Height or width is odd, which the format cannot store.
        """
        height, width = image.shape[:2]
        if height % 2 or width % 2:
            raise InvalidValueError(f"video pictures need an even width and height, got {width} x {height}.")
        if not self._is_sized:
            self._stream.width, self._stream.height = width, height
            self._is_sized = True
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))

    def __exit__(self, *exception: object) -> None:
        """Write the remaining data and close the file."""
        if self._is_sized:
            self._container.mux(self._stream.encode())
        self._container.close()
