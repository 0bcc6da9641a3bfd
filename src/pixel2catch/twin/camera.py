"""The camera's driver: it is told what there is to see, and has the image when it is due."""

import copy
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from pixel2catch.evaluation.rendered.camera import OBJECT, CameraCfg, Moment, part_times, room_positions
from pixel2catch.evaluation.rendered.room import build_room
from pixel2catch.evaluation.rendering import DRAWN_GROUPS, Renderer, find_gl_backend
from pixel2catch.robot.constants import RGB_CAMERA
from pixel2catch.robot.object_table import GEOM_FIELDS, object_indices, object_table
from pixel2catch.robot.scene import SceneCfg
from pixel2catch.twin.processes import SECOND, obey_parent

UNDRAWN_GROUP = max(DRAWN_GROUPS) + 1

SURROUNDINGS = ("world", "floor")
"""Bodies that nothing can hide behind but the sky: walls, posters, floor, and the table's pedestal."""

AWAY = (-9.0, 0.0, 1.0)
"""Where an object is that is not in the room: behind the camera [m]."""

COARSE = (16, 8)
"""Slices and stacks of round geoms; MuJoCo's own 28 and 16 take half as long again."""

CAMERA = CameraCfg(part_length=8.0)
"""The camera, with fewer pictures in an exposure: two of the fastest objects."""

NOISE_LENGTH = 1 << 21
"""Numbers in the stock of noise; every image begins somewhere else in it."""

Image = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """What there is to see.

    Attributes:
        moment: The middle of the exposure; its time is the twin's.
        object_name: What the thrower has, or has thrown; none in an empty room.
        thrower: Positions of the bystanders' joints at a time of the twin.
    """

    moment: Moment
    object_name: str | None
    thrower: Callable[[float], Float[np.ndarray, "6"]]


class RoomView:
    """Draws images; close it, or use it as a context manager, in the thread that made it."""

    def __init__(self, scene: SceneCfg, seed: int, cfg: CameraCfg = CAMERA) -> None:
        """Furnish the room and draw what stays.

        Args:
            scene: The scene of the simulation.
            seed: Of the room's looks and the sensor's noise.
            cfg: Exposure and noise of the camera.

        Raises:
            DeviceUnavailableError: If no OpenGL back end works.
        """
        self._cfg, self._objects = cfg, object_table(scene)
        self._rng = np.random.default_rng(seed)
        self._noise = self._rng.standard_normal(NOISE_LENGTH, dtype=np.float32)
        self._room = build_room(scene, self._objects.names[0], seed)
        self._room.vis.quality.numslices, self._room.vis.quality.numstacks = COARSE
        self._geoms = object_indices(self._room).geoms
        self._room.geom_sameframe[self._geoms] = 0  # as in the scene, so that objects can be exchanged
        fixed = [self._room.body(name).id for name in SURROUNDINGS]
        is_fixed = np.isin(self._room.geom_bodyid, fixed)
        with Renderer(_without(self._room, ~is_fixed), shadows=False) as renderer:
            self._background = renderer.image(self._room.qpos0).reshape(-1, 3)
        self._renderer = Renderer(_without(self._room, is_fixed), shadows=False, sky=False)

    def image(self, exposure: Exposure) -> Image:
        """The image, with motion blur and noise as of `RoomCamera`."""
        moment = exposure.moment
        if exposure.object_name is None:
            moment = without_object(moment)
        else:
            self._exchange(exposure.object_name)
        times = part_times(moment, self._cfg).tolist()
        light = self._background.astype(np.float32)
        for time in times:
            picture = self._renderer.image(room_positions(self._room, moment, time, exposure.thrower))
            shown = np.flatnonzero(picture[..., 0] | picture[..., 1] | picture[..., 2])
            change = picture.reshape(-1, 3)[shown] - self._background[shown].astype(np.float32)
            light[shown] += change / len(times)
        return self._sensed(light).reshape(RGB_CAMERA.height, RGB_CAMERA.width, 3)

    def close(self) -> None:
        """Free the drawing context."""
        self._renderer.close()

    def __enter__(self) -> "RoomView":
        """Return the view itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def _exchange(self, object_name: str) -> None:
        """Let the object look like another."""
        row, model = self._objects.names.index(object_name), self._renderer.model
        for name in GEOM_FIELDS:
            getattr(model, name)[self._geoms] = self._objects.fields[name][row]

    def _sensed(self, light: Float[np.ndarray, "num_pixels 3"]) -> UInt8[np.ndarray, "num_pixels 3"]:
        """The light with the sensor's noise."""
        start = self._rng.integers(NOISE_LENGTH - light.size)
        deviation = np.sqrt(self._cfg.read_noise**2 + self._cfg.shot_noise * light)
        deviation *= self._noise[start : start + light.size].reshape(light.shape)
        light += deviation
        return np.clip(np.rint(light, out=light), 0.0, 255.0, out=light).astype(np.uint8)


def without_object(moment: Moment) -> Moment:
    """The same moment in a room without the object."""
    qpos, qvel = moment.qpos.copy(), moment.qvel.copy()
    qpos[OBJECT], qvel[OBJECT] = AWAY, 0.0
    return replace(moment, qpos=qpos, qvel=qvel)


def _without(room: mujoco.MjModel, is_left_out: Bool[np.ndarray, " num_geoms"]) -> mujoco.MjModel:
    """The room without some of what is in it."""
    other = copy.copy(room)
    other.geom_group[is_left_out] = UNDRAWN_GROUP
    return other


LATENCY = 0.015
"""Time from the middle of the exposure to the image on the wire [s].

Source: ours, for half the exposure, readout and transfer.
"""

MOST_WAITING = 2
"""Images that may be in work; while there are as many, the next is lost."""


class Camera:
    """Images on their way from exposure to wire.

    Attributes:
        num_images: Images that came out.
        num_late: Those of them that were not drawn in time.
        num_lost: Images that were never drawn, as the ones before took too long.
    """

    def __init__(
        self,
        draw: Callable[[Exposure], "Future[Image]"],
        latency: float = LATENCY,
        clock_error: float = 0.0,
    ) -> None:
        """Begin without an image.

        Args:
            draw: Begins to draw.
            latency: Time from the middle of the exposure to the wire [s].
            clock_error: How late the clock is that stamps the images [s].
        """
        self._draw, self._latency, self._clock_error = draw, latency, clock_error
        self._waiting: deque[tuple[float, Future[Image]]] = deque()
        self._is_overdue = False
        self.num_images, self.num_late, self.num_lost = 0, 0, 0

    def expose(self, exposure: Exposure) -> None:
        """Take an image."""
        if len(self._waiting) >= MOST_WAITING:
            self.num_lost += 1
        else:
            self._waiting.append((exposure.moment.time, self._draw(exposure)))

    def developed(self, now: float) -> Iterator[tuple[float, Image]]:
        """Yield the images that are due, each with its stamp: the middle of its exposure [s]."""
        while self._waiting and self._waiting[0][0] + self._latency <= now:
            time, image = self._waiting[0]
            if not image.done():
                self._is_overdue = True
                return
            self._waiting.popleft()
            self.num_images += 1
            self.num_late += self._is_overdue
            self._is_overdue = False
            yield time - self._clock_error, image.result()


@contextmanager
def drawing_process(scene: SceneCfg, seed: int) -> Iterator[Callable[[Exposure], "Future[Image]"]]:
    """A process that draws what the camera sees, so that the physics keeps its time.

    Args:
        scene: The scene of the simulation.
        seed: Of the room's looks and the sensor's noise.

    Yields:
        Function that begins to draw.

    Raises:
        DeviceUnavailableError: If no OpenGL back end works.
    """
    find_gl_backend()
    with ProcessPoolExecutor(1, get_context("spawn"), _open, (scene, seed)) as process:
        process.submit(_is_open).result()
        yield lambda exposure: process.submit(_draw, exposure)


_VIEWS: list[RoomView] = []
"""The view of a process that draws."""


def _open(scene: SceneCfg, seed: int) -> None:
    obey_parent(SECOND)
    torch.set_num_threads(1)
    _VIEWS.append(RoomView(scene, seed))


def _is_open() -> bool:
    return bool(_VIEWS)


def _draw(exposure: Exposure) -> Image:
    return _VIEWS[0].image(exposure)
