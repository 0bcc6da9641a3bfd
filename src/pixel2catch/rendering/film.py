"""Films of throws: a view that comes closer, path and slow motion, the robot's own view, a caption.

Several throws are shown at once in a grid, or one after the other; a strip has a few stills of one.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from itertools import chain
from math import ceil, sqrt
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image

from pixel2catch.checks import OutputFile
from pixel2catch.evaluation.recorded_throws import RecordedThrow
from pixel2catch.rendering.caption import add_caption, add_inset
from pixel2catch.rendering.renderer import RGB_VIEW, Renderer, View
from pixel2catch.rendering.room import Bystanders, build_film_room
from pixel2catch.rendering.storyboard import (
    FPS,
    Storyboard,
    positions_between,
    storyboard,
)
from pixel2catch.rendering.video import FORMATS, draw_box, write_film
from pixel2catch.scene.constants import CONTROL_DT, OBJECT_POS
from pixel2catch.scene.scene import GEOM_FIELDS, SceneCfg, object_indices, object_table
from pixel2catch.workcells import find_workcell

Picture = UInt8[ndarray, "height width 3"]
Views = Literal["both", "outside", "rgb"]
"""What a film shows: the throw from outside with the robot's own view in a corner, or one of the two."""

WIDE = View(lookat=(1.12, 0.0, 1.12), distance=2.3, azimuth=52.0, elevation=-11.0)  #: Robot and thrower.
CLOSE = View(distance=1.05, azimuth=44.0, elevation=-18.0)  #: The hand, in the middle of the picture.
#: Of several robots, from the thrower's side and above: no arm is before the hands.
WIDE_OF_SEVERAL = View(lookat=(1.3, 0.0, 1.05), distance=3.1, azimuth=110.0, elevation=-17.0)
CLOSE_OF_SEVERAL = View(distance=1.45, azimuth=136.0, elevation=-38.0)
WIDTHS = (800, 480, 400, 320)  #: Width of a throw [px] by the number of throws side by side, from one on.
DETAIL = 1.5  #: Drawn pixels in one of a film, along each side.
ROUNDNESS = (20, 10)  #: Slices and stacks of round geoms.
INSET_PART = 2  #: How many times smaller than the camera's image the robot's own view is drawn.
STILLS = 6  #: Pictures in a strip.
LAST_PICTURES = 20  #: How often the last picture of a film is shown.


class FilmRenderer(AbstractContextManager["FilmRenderer"]):
    """Draws throws in one room; close it, or use it as a context manager."""

    def __init__(
        self, scene: SceneCfg, views: Views = "both", width: int = WIDTHS[1], meshes: Path | None = None
    ) -> None:
        """Furnish the room.

        Args:
            scene: What was simulated.
            views: What is shown.
            width: Of a picture [px].
            meshes: Folder of a checkout of the MuJoCo Menagerie, whose meshes the robots shall look like.

        Raises:
            DeviceUnavailableError: If no OpenGL back end works.
        """
        self._views, self._width, self._height = views, width, width * 9 // 16 // 2 * 2
        self._workcell, self._objects = find_workcell(scene.workcell), object_table(scene)
        is_one = len(self._workcell.palms) == 1
        self._wide, self._close = (WIDE, CLOSE) if is_one else (WIDE_OF_SEVERAL, CLOSE_OF_SEVERAL)
        self._room = build_film_room(scene, self._objects.names[0], meshes)
        self._geoms = object_indices(self._room).geoms
        self._room.geom_sameframe[self._geoms] = 0  # as in the scene, so that objects can be exchanged
        self._room.vis.quality.numslices, self._room.vis.quality.numstacks = ROUNDNESS
        self._newest: tuple[int, Picture] | None = None
        with ExitStack() as stack:
            wide = replace(self._wide, width=round(DETAIL * width), height=round(DETAIL * self._height))
            self._outside = stack.enter_context(Renderer(self._room, wide))
            part = 1 if views == "rgb" else INSET_PART
            inside = replace(RGB_VIEW, width=RGB_VIEW.width // part, height=RGB_VIEW.height // part)
            self._inside = stack.enter_context(Renderer(self._room, inside, shadows=False))
            self._opened = stack.pop_all()

    def __exit__(self, *exception: object) -> None:
        """Free the drawing contexts."""
        self._opened.close()

    def film(self, throw: RecordedThrow) -> Iterator[Picture]:
        """The pictures of a throw; the last one is repeated."""
        board = self._begin(throw)
        last = len(board.steps) - 1
        for i in range(last):
            yield self._picture(throw, board, i)
        yield from [self._picture(throw, board, last)] * LAST_PICTURES

    def strip(self, throw: RecordedThrow) -> Picture:
        """Stills of a throw, from left to right."""
        board = self._begin(throw).stills(STILLS)
        return np.concatenate([self._picture(throw, board, i) for i in range(STILLS)], axis=1)

    def _begin(self, throw: RecordedThrow) -> Storyboard:
        """Put the object of a throw into the room."""
        row, self._newest = self._objects.names.index(throw.object_name), None
        for renderer in (self._outside, self._inside):
            for name in GEOM_FIELDS:
                getattr(renderer.model, name)[self._geoms] = self._objects.fields[name][row]
        return storyboard(throw, self._workcell)

    def _picture(self, throw: RecordedThrow, board: Storyboard, i: int) -> Picture:
        step = float(board.steps[i])
        if self._views == "rgb":
            image = Image.fromarray(self._robots_view(throw, step))
            image = image.resize((self._width, self._width * 3 // 4 // 2 * 2))
        else:
            drawn = self._outside.image(
                self._positions(throw, step), self._view(board, i), self._path(throw, step, board.catch)
            )
            image = Image.fromarray(drawn).resize((self._width, self._height), Image.Resampling.LANCZOS)
            if self._views == "both":
                add_inset(image, self._robots_view(throw, step))
        is_over = step >= board.decision or i == len(board.steps) - 1
        add_caption(image, throw, is_slow=bool(board.is_slow[i]), is_over=is_over)
        return np.asarray(image)

    def _view(self, board: Storyboard, i: int) -> View:
        def between(wide: float, close: float) -> float:
            return wide + float(board.closeness[i]) * (close - wide)

        far, near = self._wide, self._close
        x, y, z = (between(*each) for each in zip(far.lookat, board.focus[i].tolist(), strict=True))
        return View(
            lookat=(x, y, z),
            distance=between(far.distance, near.distance),
            azimuth=between(far.azimuth, near.azimuth),
            elevation=between(far.elevation, near.elevation),
        )

    def _path(self, throw: RecordedThrow, step: float, catch: int) -> Float[ndarray, "num_points 3"] | None:
        """Where the object has been from its release to the catch."""
        whole = throw.qpos[throw.release : min(ceil(step), catch + 1), OBJECT_POS]
        newest = positions_between(self._room, throw, min(step, catch))[OBJECT_POS]
        return np.vstack((whole, newest)) if len(whole) else None

    def _robots_view(self, throw: RecordedThrow, step: float) -> Picture:
        """The newest image of the robot's camera, with the box that the policy got then."""
        taken = int(step)
        if self._newest is None or self._newest[0] != taken:
            image = self._inside.image(self._positions(throw, taken))
            draw_box(image, throw.box[taken] * image.shape[1] / RGB_VIEW.width)
            self._newest = taken, image
        return self._newest[1]

    def _positions(self, throw: RecordedThrow, step: float) -> Float[ndarray, " num_positions"]:
        bystanders = Bystanders(release_pos=throw.qpos[0][OBJECT_POS], phase=0.3)
        time = (step - throw.release) * CONTROL_DT
        return np.concatenate((positions_between(self._room, throw, step), bystanders.joint_pos(time)))


def strips(
    throws: Sequence[RecordedThrow], scene: SceneCfg, views: Views = "both", meshes: Path | None = None
) -> list[Picture]:
    """Stills of every throw, side by side in a strip."""
    with FilmRenderer(scene, views, WIDTHS[-1], meshes) as renderer:
        return [renderer.strip(throw) for throw in throws]


def write_throws(
    path: Path,
    throws: Sequence[RecordedThrow],
    scene: SceneCfg,
    views: Views = "both",
    *,
    is_grid: bool = True,
    meshes: Path | None = None,
    on_throw: Callable[[int], None] = lambda _: None,
) -> int:
    """Write a film of throws, or stills of them if the file is a PNG, and return the number of pictures.

    They are side by side in a grid, or one after the other. Before a throw is drawn, `on_throw` is called
    with its number.

    Raises:
        InvalidValueError: If the file cannot be written; nothing was drawn then.
        DeviceUnavailableError: If nothing can be drawn on this machine; the message says what to install.
    """
    OutputFile(FORMATS).require("the film", path)
    if path.suffix.lower() == ".png":
        Image.fromarray(np.concatenate(strips(throws, scene, views, meshes))).save(path)
        return STILLS * len(throws)
    columns = ceil(sqrt(len(throws))) if is_grid else 1
    with FilmRenderer(scene, views, WIDTHS[min(columns, len(WIDTHS)) - 1], meshes) as renderer:
        films = (_film(renderer, number, throw, on_throw) for number, throw in enumerate(throws))
        pictures = _side_by_side(map(list, films), columns) if is_grid else chain.from_iterable(films)
        return write_film(path, pictures, FPS)


def _film(
    renderer: FilmRenderer, number: int, throw: RecordedThrow, on_throw: Callable[[int], None]
) -> Iterator[Picture]:
    """The pictures of a throw, of which it is said before that it is drawn now."""
    on_throw(number)
    yield from renderer.film(throw)


def _side_by_side(films: Iterable[list[Picture]], columns: int) -> Iterator[Picture]:
    """Films at once, the last pictures of the shorter ones to the end."""
    several = [*films]
    for i in range(max(map(len, several), default=0)):
        yield tiled([film[min(i, len(film) - 1)] for film in several], columns)


def tiled(pictures: Sequence[Picture], columns: int) -> UInt8[ndarray, "all_rows all_columns 3"]:
    """Pictures of one size in rows of so many; what is left of the last row is black."""
    missing = -len(pictures) % columns
    cells = [*pictures, *[np.zeros_like(pictures[0])] * missing]
    rows = [np.concatenate(cells[i : i + columns], axis=1) for i in range(0, len(cells), columns)]
    return np.concatenate(rows)
