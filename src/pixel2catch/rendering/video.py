"""Videos of throws: what the robot's camera sees, with the policy's box, and a view from outside."""

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.rendering.renderer import OUTSIDE_VIEW, RGB_VIEW, Renderer, View
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import SceneCfg, build_model

VIEWS: dict[str, tuple[View, ...]] = {
    "rgb": (RGB_VIEW,),
    "outside": (OUTSIDE_VIEW,),
    "both": (OUTSIDE_VIEW, RGB_VIEW),
}
"""What a picture shows, from left to right."""

BOX_COLOR = (80, 255, 80)
BOX_WIDTH = 2  #: Width of a drawn box's edge [px].


@dataclass(frozen=True, kw_only=True)
class RecordedThrow:
    """One throw, from its start to the decision of the trial."""

    object_name: str  #: What was thrown.
    qpos: Float[ndarray, "num_steps nq"]  #: Positions of the simulation at every control step.
    qvel: Float[ndarray, "num_steps nv"]  #: Its velocities.
    box: Float[ndarray, "num_steps 4"]  #: The box that the policy got [px].
    num_untested: int  #: Control steps before the test of the hold; all if there was no success.


def write_video(
    path: Path, throws: Iterable[RecordedThrow], scene: SceneCfg, view: str = "both", *, shadows: bool = True
) -> int:
    """Draw throws one after the other, in a view out of `VIEWS`, and return the number of pictures.

    Raises:
        UnknownNameError: If there is no such view.
        DeviceUnavailableError: If nothing can be drawn on this machine; the message says what to install.
    """
    if view not in VIEWS:
        raise UnknownNameError("view", view, VIEWS)
    num_pictures = 0
    with VideoWriter(path, fps=round(1.0 / CONTROL_DT)) as video:
        for throw in throws:
            for picture in _pictures(throw, scene, VIEWS[view], shadows):
                video.write(picture)
                num_pictures += 1
    return num_pictures


def draw_box(image: UInt8[ndarray, "height width 3"], box: Float[ndarray, "4"]) -> None:
    """Draw the edges of a box (xmin, ymin, xmax, ymax [px]) and a mark in its middle into an image."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = (round(float(value)) for value in box)
    x, y = (x0 + x1) // 2, (y0 + y1) // 2
    e = BOX_WIDTH
    outline = ((x0, y0, x1, y0 + e), (x0, y1 - e, x1, y1), (x0, y0, x0 + e, y1), (x1 - e, y0, x1, y1))
    for left, top, right, bottom in (*outline, (x - e, y - e, x + e, y + e)):
        rows = slice(max(top, 0), min(max(bottom, 0), height))
        columns = slice(max(left, 0), min(max(right, 0), width))
        image[rows, columns] = BOX_COLOR


def _pictures(
    throw: RecordedThrow, scene: SceneCfg, views: tuple[View, ...], shadows: bool
) -> Iterator[UInt8[ndarray, "height width 3"]]:
    model = build_model(replace(scene, visuals=True), throw.object_name)
    with ExitStack() as stack:
        renderers = [stack.enter_context(Renderer(model, view, shadows=shadows)) for view in views]
        for qpos, box in zip(throw.qpos, throw.box, strict=True):
            images = [renderer.image(qpos) for renderer in renderers]
            for view, image in zip(views, images, strict=True):
                if view is RGB_VIEW:
                    draw_box(image, box)
            yield np.concatenate(images, axis=1)


class VideoWriter(AbstractContextManager["VideoWriter"]):
    """Writes pictures of one size to an H.264 file; close it, or use it as a context manager."""

    def __init__(self, path: Path, *, fps: int = 30, crf: int = 23, gop: int | None = None) -> None:
        """Open the file; its ending names the container, such as .mp4.

        `crf` is the constant rate factor: lower is better and larger. Of `gop` pictures one is stored whole,
        from where a reader can begin; the encoder's own choice if absent.

        Raises:
            InvalidValueError: If the folder does not exist, or the ending names no format.
        """
        if not path.parent.is_dir():
            raise InvalidValueError(f"cannot write '{path}': there is no folder '{path.parent}'.")
        try:
            self._container = av.open(str(path), "w")
        except ValueError as error:
            raise InvalidValueError(f"cannot write '{path}': {error}; end its name in .mp4.") from error
        options = {"crf": str(crf)} | ({"g": str(gop)} if gop else {})
        self._stream: Any = self._container.add_stream("libx264", rate=Fraction(fps), options=options)
        self._stream.pix_fmt = "yuv420p"
        self._is_sized = False

    def write(self, image: UInt8[np.ndarray, "height width 3"]) -> None:
        """Append one picture (red, green, blue).

        Raises:
            InvalidValueError: If height or width is odd, which the format cannot store.
        """
        height, width = image.shape[:2]
        if height % 2 or width % 2:
            raise InvalidValueError(f"video pictures need an even width and height, got {width} x {height}.")
        if not self._is_sized:
            self._stream.width, self._stream.height = width, height
            self._is_sized = True
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))

    def close(self) -> None:
        """Write what is left and close the file."""
        if self._is_sized:
            self._container.mux(self._stream.encode())
        self._container.close()

    def __exit__(self, *exception: object) -> None:
        """Close the file."""
        self.close()
