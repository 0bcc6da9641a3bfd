"""Films of throws: a view that comes closer, the object's path, slow motion, the robot's view, a caption.

Several throws are shown at once in a grid; a strip has a few stills of one throw.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import uniform_filter1d

from pixel2catch.camera.image import Pixels
from pixel2catch.evaluation.protocol import CAUGHT, LOST, OUTCOMES, RecordedThrow
from pixel2catch.rendering.renderer import RGB_VIEW, Renderer, Viewpoint
from pixel2catch.rendering.room import Bystanders, build_film_room
from pixel2catch.rendering.video import draw_box, write_film
from pixel2catch.robots.geometry import chain_of
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.constants import CONTROL_DT, OBJECT_POS
from pixel2catch.scene.scene import GEOM_FIELDS, SceneCfg, object_indices, object_table
from pixel2catch.workcells import find_workcell

#: Views of robot and thrower, and of the hand, which is in the middle of the picture.
WIDE = Viewpoint(lookat=(1.12, 0.0, 1.12), distance=2.3, azimuth=52.0, elevation=-11.0)
CLOSE = Viewpoint(distance=1.05, azimuth=44.0, elevation=-18.0)

#: The same of several robots, from the thrower's side and above, so that no arm hides the hands.
WIDE_OF_SEVERAL = Viewpoint(lookat=(1.3, 0.0, 1.05), distance=3.1, azimuth=110.0, elevation=-17.0)
CLOSE_OF_SEVERAL = Viewpoint(distance=1.45, azimuth=136.0, elevation=-38.0)

WIDTHS = (800, 480, 400, 320)  #: Width of a throw [px] by the number of throws side by side, from one on.
DETAIL = 1.5  #: Drawn pixels per pixel of a film, along each side.
ROUNDNESS = (20, 10)  #: Slices and stacks of round geoms.
INSET_PART = 2  #: Ratio of the camera's image to the drawn robot's view, along each side.
STILLS = 6  #: Pictures in a strip.
LAST_PICTURES = 20  #: Number of times that the last picture of a film is shown.

INSET_SHARE = 0.27  #: Width of the robot's view over that of the picture.
TEXT_SHARE = 0.048  #: Height of letters over that of the picture.
LEAST_TEXT = 11  #: Least height of letters [px].
INK = (255, 255, 255)
GROUND, GOOD, BAD = (24, 28, 34), (28, 116, 68), (172, 48, 40)
"""Colours behind text: of the throw, of a catch, and of a miss."""

SIZE_WORDS = {"s": "small", "l": "large"}  #: Last parts of an object's name.

FPS = 25  #: Pictures of a film per second.
SLOW = 4  #: Ratio by which the catch is slower.
REACH = 0.12  #: Distance of object and palm from which the catch begins [m].
BEFORE_RELEASE, BEFORE_CATCH, AFTER_CATCH, AFTER_OUTCOME, LONGEST = 6, 5, 7, 12, 45
"""Control steps: shown before the release, slow before and after the catch, shown after the outcome, and
largest number shown after the catch."""

ZOOM_STEPS = 9  #: Control steps in which the view comes closer, before the catch.
FOLLOWED_STEPS = 15  #: Control steps over which the hand's motion is averaged for the view.


@dataclass(frozen=True, kw_only=True)
class Storyboard:
    """Plan of a film: what each picture shows."""

    steps: Float[ndarray, " num_pictures"]  #: Control step; fractions are between two steps.
    is_slow: Bool[ndarray, " num_pictures"]  #: Whether the picture is in slow motion.
    closeness: Float[ndarray, " num_pictures"]  #: 0 shows the whole room, 1 the hand.
    decision: int  #: Control step in which the outcome is known.
    catch: int  #: First control step with the object within `REACH` of a palm, else that nearest to one.
    focus: Float[ndarray, "num_pictures 3"]  #: Position of the hand; before the catch, that at the catch [m].


def storyboard(throw: RecordedThrow, workcell: WorkcellSpec) -> Storyboard:
    """Return the plan of a film from just before the release to the outcome."""
    catch, focus = _catch(throw, workcell)
    last = len(throw.qpos) - 1
    decision = last if throw.outcome == LOST else throw.num_untested - 1
    begin = max(throw.release - BEFORE_RELEASE, 0)
    end = max(min(last, decision + AFTER_OUTCOME, catch + LONGEST), catch)
    slow_from, slow_to = max(catch - BEFORE_CATCH, begin), min(catch + AFTER_CATCH, end)
    pace = 1.0 / (FPS * CONTROL_DT)
    spans = ((begin, slow_from, pace), (slow_from, slow_to, pace / SLOW), (slow_to, end, pace))
    steps = np.concatenate([*(np.arange(*span) for span in spans), (end,)])
    share = np.clip((steps - catch + ZOOM_STEPS) / ZOOM_STEPS, 0.0, 1.0)
    return Storyboard(
        steps=steps,
        is_slow=(steps >= slow_from) & (steps < slow_to),
        closeness=share * share * (3.0 - 2.0 * share),
        decision=decision,
        catch=catch,
        focus=np.stack([np.interp(steps, np.arange(len(focus)), column) for column in focus.T], axis=-1),
    )


def _positions_between(
    model: mujoco.MjModel, throw: RecordedThrow, step: float
) -> Float[ndarray, " num_positions"]:
    """Return the interpolated positions of the simulation at a control step with fractions."""
    first = min(int(step), len(throw.qpos) - 1)
    second, change = min(first + 1, len(throw.qpos) - 1), np.zeros(model.nv)
    others = model.qpos0[throw.qpos.shape[1] :]  # joints behind those of the simulation
    before, after = (np.concatenate((throw.qpos[i], others)) for i in (first, second))
    mujoco.mj_differentiatePos(model, change, 1.0, before, after)
    mujoco.mj_integratePos(model, before, change, step - first)
    return before[: throw.qpos.shape[1]]


def _catch(throw: RecordedThrow, workcell: WorkcellSpec) -> tuple[int, Float[ndarray, "num_steps 3"]]:
    """Return the control step of the catch, and the smoothed positions of the palm from then on."""
    qpos = torch.from_numpy(np.asarray(throw.qpos, dtype=np.float64))
    chains = [(palm.carriers, chain_of(workcell, palm)) for palm in workcell.palms]
    palms = torch.stack([chain.pose(qpos[:, carriers])[0] for carriers, chain in chains])
    distances, nearest = (palms - qpos[:, OBJECT_POS]).norm(dim=-1).min(dim=0)
    reached = distances <= max(REACH, float(distances.min()))
    step = int(torch.nonzero(reached)[0])
    way = palms[int(nearest[step])].numpy().copy()
    way[:step] = way[step]
    return step, uniform_filter1d(way, FOLLOWED_STEPS, axis=0, mode="nearest")


class FilmRenderer(AbstractContextManager["FilmRenderer"]):
    """Draws throws in one room; a context manager."""

    def __init__(self, scene: SceneCfg, width: int) -> None:
        """Build the plain film room of a scene and its renderers, for pictures of this width [px]."""
        self._width, self._height = width, width * 9 // 16 // 2 * 2
        self._workcell, self._objects = find_workcell(scene.workcell), object_table(scene)
        is_one = len(self._workcell.palms) == 1
        self._wide, self._close = (WIDE, CLOSE) if is_one else (WIDE_OF_SEVERAL, CLOSE_OF_SEVERAL)
        self._room = build_film_room(scene, self._objects.names[0])
        self._geoms = object_indices(self._room).geoms
        self._room.geom_sameframe[self._geoms] = 0  # as in the scene, so that objects can be exchanged
        self._room.vis.quality.numslices, self._room.vis.quality.numstacks = ROUNDNESS
        self._newest: tuple[int, Pixels] | None = None
        wide = replace(self._wide, width=round(DETAIL * width), height=round(DETAIL * self._height))
        width, height = RGB_VIEW.width // INSET_PART, RGB_VIEW.height // INSET_PART
        inside = replace(RGB_VIEW, width=width, height=height)
        self._outside, self._inside = Renderer(self._room, wide), Renderer(self._room, inside, shadows=False)

    def __exit__(self, *exception: object) -> None:
        self._outside.close()
        self._inside.close()

    def film(self, throw: RecordedThrow) -> Iterator[Pixels]:
        """Yield the pictures of a throw; the last one is repeated."""
        board = self._begin(throw)
        last = len(board.steps) - 1
        for i in range(last):
            yield self._picture(throw, board, i)
        yield from [self._picture(throw, board, last)] * LAST_PICTURES

    def strip(self, throw: RecordedThrow) -> Pixels:
        """Return stills of a throw, from left to right."""
        board = self._begin(throw)
        flight = np.linspace(board.steps[0] + BEFORE_RELEASE, board.catch, STILLS // 2, endpoint=False)
        steps = np.append(flight, np.linspace(board.catch, board.steps[-1], STILLS - len(flight)))
        board = replace(board, is_slow=np.zeros(len(board.steps), dtype=bool))
        chosen = np.searchsorted(board.steps, steps).tolist()
        return np.concatenate([self._picture(throw, board, i) for i in chosen], axis=1)

    def _begin(self, throw: RecordedThrow) -> Storyboard:
        row, self._newest = self._objects.names.index(throw.object_name), None
        for renderer in (self._outside, self._inside):
            for name in GEOM_FIELDS:
                getattr(renderer.model, name)[self._geoms] = self._objects.fields[name][row]
        return storyboard(throw, self._workcell)

    def _picture(self, throw: RecordedThrow, board: Storyboard, i: int) -> Pixels:
        step = float(board.steps[i])
        path = self._path(throw, step, board.catch)
        drawn = self._outside.image(self._positions(throw, step), self._viewpoint(board, i), path)
        image = Image.fromarray(drawn).resize((self._width, self._height), Image.Resampling.LANCZOS)
        _add_inset(image, self._robots_view(throw, step))
        is_over = step >= board.decision or i == len(board.steps) - 1
        _add_caption(image, throw, is_slow=bool(board.is_slow[i]), is_over=is_over)
        return np.asarray(image)

    def _viewpoint(self, board: Storyboard, i: int) -> Viewpoint:
        def between(wide: float, close: float) -> float:
            return wide + float(board.closeness[i]) * (close - wide)

        far, near = self._wide, self._close
        x, y, z = (between(*each) for each in zip(far.lookat, board.focus[i].tolist(), strict=True))
        names = ("distance", "azimuth", "elevation")
        turned: dict[str, Any] = {name: between(getattr(far, name), getattr(near, name)) for name in names}
        return Viewpoint(lookat=(x, y, z), **turned)

    def _path(self, throw: RecordedThrow, step: float, catch: int) -> Float[ndarray, "num_points 3"] | None:
        whole = throw.qpos[throw.release : min(ceil(step), catch + 1), OBJECT_POS]
        newest = _positions_between(self._room, throw, min(step, catch))[OBJECT_POS]
        return np.vstack((whole, newest)) if len(whole) else None

    def _robots_view(self, throw: RecordedThrow, step: float) -> Pixels:
        """Return the newest image of the robot's camera, with the box that the policy got then."""
        taken = int(step)
        if self._newest is None or self._newest[0] != taken:
            image = self._inside.image(self._positions(throw, taken))
            draw_box(image, throw.box[taken] * image.shape[1] / RGB_VIEW.width)
            self._newest = taken, image
        return self._newest[1]

    def _positions(self, throw: RecordedThrow, step: float) -> Float[ndarray, " num_positions"]:
        bystanders = Bystanders(release_pos=throw.qpos[0][OBJECT_POS], phase=0.3)
        time = (step - throw.release) * CONTROL_DT
        return np.concatenate((_positions_between(self._room, throw, step), bystanders.joint_pos(time)))


def write_throws(
    path: Path,
    throws: Sequence[RecordedThrow],
    scene: SceneCfg,
    on_throw: Callable[[int], None] = lambda _: None,
) -> int:
    """Write a film of throws in a grid, or stills if the file is a PNG; return the number of pictures.

    Before each throw is drawn, `on_throw` is called with its number.
    """
    if path.suffix.lower() == ".png":
        with FilmRenderer(scene, WIDTHS[-1]) as renderer:
            strips = [renderer.strip(throw) for throw in throws]
        write_film(path, [np.concatenate(strips)], FPS)
        return STILLS * len(throws)
    return write_film(path, _grids(throws, scene, on_throw), FPS)


def _grids(
    throws: Sequence[RecordedThrow], scene: SceneCfg, on_throw: Callable[[int], None]
) -> Iterator[Pixels]:
    """Yield pictures of all throws in rows; shorter films repeat their last picture."""
    columns, films = ceil(sqrt(len(throws))), []
    with FilmRenderer(scene, WIDTHS[min(columns, len(WIDTHS)) - 1]) as renderer:
        for number, throw in enumerate(throws):
            on_throw(number)
            films.append([*renderer.film(throw)])
    for i in range(max(map(len, films))):
        cells = [film[min(i, len(film) - 1)] for film in films]
        cells += [np.zeros_like(cells[0])] * (-len(cells) % columns)
        rows = [np.concatenate(cells[j : j + columns], axis=1) for j in range(0, len(cells), columns)]
        yield np.concatenate(rows)


def _add_inset(image: Image.Image, other: Pixels) -> None:
    width, gap = round(INSET_SHARE * image.width), max(image.height // 30, 4)
    size = (width, width * other.shape[0] // other.shape[1])
    inset = Image.fromarray(other).resize(size, Image.Resampling.BOX)
    x, y = image.width - inset.width - gap, image.height - inset.height - gap
    ImageDraw.Draw(image).rectangle((x - 2, y - 2, x + inset.width + 1, y + inset.height + 1), fill=INK)
    image.paste(inset, (x, y))


def _add_caption(image: Image.Image, throw: RecordedThrow, *, is_slow: bool, is_over: bool) -> None:
    gap = max(image.height // 30, 4)
    _write(image, title(throw.object_name), (gap, gap), "la", GROUND)
    if is_slow:
        _write(image, f"{SLOW} times slower", (image.width - gap, gap), "ra", GROUND)
    if is_over:
        ground = GOOD if throw.outcome == CAUGHT else BAD
        _write(image, OUTCOMES[throw.outcome], (gap, image.height - gap), "ld", ground)


def title(object_name: str) -> str:
    """Return the name of an object in words."""
    *words, last = object_name.split("_")
    return " ".join((SIZE_WORDS[last], *words) if last in SIZE_WORDS and words else (*words, last))


def _write(
    image: Image.Image, text: str, corner: tuple[int, int], anchor: str, ground: tuple[int, int, int]
) -> None:
    """Write text on a coloured box; the anchor is Pillow's, of the corner of the box."""
    size = max(round(TEXT_SHARE * image.height), LEAST_TEXT)
    pad, draw = size // 2, ImageDraw.Draw(image)
    way = (1 if anchor[0] == "l" else -1, 1 if anchor[1] == "a" else -1)
    x, y = (place + sign * pad for place, sign in zip(corner, way, strict=True))
    left, top, right, bottom = draw.textbbox((x, y), text, font=_font(size), anchor=anchor)
    box = (left - pad, top - pad // 2, right + pad, bottom + pad // 2)
    draw.rounded_rectangle(box, radius=pad, fill=ground)
    draw.text((x, y), text, fill=INK, font=_font(size), anchor=anchor)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
