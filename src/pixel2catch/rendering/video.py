"""Video files and animations, and the box of the policy in a picture."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import replacing

WEBP_QUALITY, WEBP_EFFORT = 60, 4  #: Of 100, and of 6.
BOX_COLOR = (80, 255, 80)
BOX_WIDTH = 2  #: Width of a drawn box's edge [px].


def write_film(path: Path, pictures: Iterable[UInt8[ndarray, "height width 3"]], fps: int) -> int:
    """Write pictures as a video or a repeating animation, by the file's ending; return their number."""
    if path.suffix.lower() == ".mp4":
        return write_video(path, pictures, fps=fps)
    first, *others = (Image.fromarray(picture) for picture in pictures)
    options: Any = {"duration": 1000 // fps, "loop": 0, "quality": WEBP_QUALITY, "method": WEBP_EFFORT}
    with replacing(path) as temporary:
        first.save(temporary, save_all=True, append_images=others, **options)
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


def write_video(
    path: Path, pictures: Iterable[UInt8[ndarray, "height width 3"]], *, fps: int = 30, crf: int = 23
) -> int:
    """Write pictures to an H.264 file as they come; return their number.

    A lower `crf` is better and gives a larger file. The format cannot store an odd height or width.
    """
    number = 0
    with replacing(path) as temporary, av.open(str(temporary), "w") as container:
        stream: Any = container.add_stream("libx264", rate=Fraction(fps), options={"crf": str(crf)})
        stream.pix_fmt = "yuv420p"
        for number, picture in enumerate(pictures, start=1):
            height, width = picture.shape[:2]
            if height % 2 or width % 2:
                raise InvalidValueError(f"a video needs an even width and height, not {width} x {height}.")
            if number == 1:
                stream.width, stream.height = width, height
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if number:
            container.mux(stream.encode())
    return number
