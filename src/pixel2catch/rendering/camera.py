"""A camera in the furnished room, with an exposure time and a noisy sensor."""

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from math import ceil

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from pixel2catch.camera.image import Pixels
from pixel2catch.camera.pinhole import project
from pixel2catch.rendering.renderer import UNDRAWN_GROUP, Renderer
from pixel2catch.rendering.room import build_room
from pixel2catch.robots.geometry import chain_of
from pixel2catch.scene.constants import OBJECT_POS, OBJECT_VEL
from pixel2catch.scene.scene import GEOM_FIELDS, SceneCfg, object_indices, object_table
from pixel2catch.workcells import find_workcell

SURROUNDINGS = ("world", "floor")  #: Bodies that are drawn once: walls, posters, floor, pedestal.
AWAY = (-9.0, 0.0, 1.0)  #: Position of an absent object, behind the camera [m].
COARSE = (16, 8)  #: Slices and stacks of round geoms; fewer than MuJoCo's, to be faster.
NOISE_LENGTH = 1 << 21  #: Number of stored noise values; every image begins at a random one.


@dataclass(frozen=True, kw_only=True)
class CameraCfg:
    """Exposure and noise of the camera."""

    exposure: float = 0.008  #: Exposure time [s]. Source: ours; the fastest objects move 15 px in it.
    part_length: float = 4.0  #: Largest motion between two pictures of an exposure [px]. Source: ours.
    read_noise: float = 1.5  #: Standard deviation of the noise without light [levels]. Source: ours.
    shot_noise: float = 0.05  #: Variance of the noise per level of light [levels²]. Source: ours.


FAST_CAMERA = CameraCfg(part_length=8.0)  #: Fewer pictures per exposure: two for the fastest objects.


@dataclass(frozen=True, kw_only=True)
class Moment:
    """State of the scene in the middle of an exposure."""

    qpos: Float[np.ndarray, " nq"]  #: Positions of the simulation: robot, then object.
    qvel: Float[np.ndarray, " nv"]  #: Its velocities, taken as constant during the exposure.
    time: float  #: Time of the bystanders' motion [s].


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """What an image shows."""

    moment: Moment  #: The middle of the exposure.
    object_name: str | None  #: Object that is held or thrown; none in an empty room.
    thrower: Callable[[float], Float[np.ndarray, "6"]]  #: Positions of the bystanders' joints at a time [s].


class RoomCamera(AbstractContextManager["RoomCamera"]):
    """Takes images in a room; a context manager, in the thread that made it.

    Without shadows, the background is drawn once, and every image adds robot, thrower, object and table. With
    shadows, everything is drawn in every image, which is much slower without a GPU.
    """

    def __init__(
        self,
        scene: SceneCfg,
        seed: int,
        cfg: CameraCfg = FAST_CAMERA,
        *,
        room: int | None = None,
        shadows: bool = False,
    ) -> None:
        """Furnish the room and draw the background; `room` is the seed of its looks, by default `seed`."""
        self._cfg, self._camera, self._objects = cfg, scene.camera, object_table(scene)
        cell = find_workcell(scene.workcell)
        self._chains = [(palm.carriers, chain_of(cell, palm)) for palm in cell.palms]
        self._rng = np.random.default_rng(seed)
        self._noise = self._rng.standard_normal(NOISE_LENGTH, dtype=np.float32)
        self._room = build_room(scene, self._objects.names[0], seed if room is None else room)
        self._geoms = object_indices(self._room).geoms
        self._room.geom_sameframe[self._geoms] = 0  # as in the scene, so that objects can be exchanged
        self._background = None
        if shadows:
            self._renderer = Renderer(self._room)
            return
        self._room.vis.quality.numslices, self._room.vis.quality.numstacks = COARSE
        is_fixed = np.isin(self._room.geom_bodyid, [self._room.body(name).id for name in SURROUNDINGS])
        with Renderer(_without(self._room, ~is_fixed), shadows=False) as renderer:
            self._background = renderer.image(self._room.qpos0).reshape(-1, 3)
        self._renderer = Renderer(_without(self._room, is_fixed), shadows=False, sky=False)

    def image(self, exposure: Exposure) -> Pixels:
        """Return the image, with motion blur and noise."""
        moment = self._shown(exposure)
        num_parts = max(ceil(self._smear(moment) / self._cfg.part_length), 1)
        times = self._cfg.exposure * ((np.arange(num_parts) + 0.5) / num_parts - 0.5)
        positions = [room_positions(self._room, moment, time, exposure.thrower) for time in times.tolist()]
        pictures = (self._renderer.image(qpos) for qpos in positions)
        if self._background is None:
            light = np.mean(list(pictures), axis=0, dtype=np.float32).reshape(-1, 3)
        else:
            light = self._background.astype(np.float32)
            for picture in pictures:
                shown = np.flatnonzero(picture[..., 0] | picture[..., 1] | picture[..., 2])
                change = picture.reshape(-1, 3)[shown] - self._background[shown].astype(np.float32)
                light[shown] += change / len(times)
        return self._sensed(light).reshape(self._camera.height, self._camera.width, 3)

    def object_mask(self, exposure: Exposure) -> Bool[np.ndarray, "height width"]:
        """Return which pixels show the object in the middle of the exposure."""
        moment = self._shown(exposure)
        return self._renderer.object_mask(room_positions(self._room, moment, 0.0, exposure.thrower))

    def __exit__(self, *exception: object) -> None:
        self._renderer.close()

    def _shown(self, exposure: Exposure) -> Moment:
        """Give the object the shape of the exposure's, or move it away; return the moment to draw."""
        if exposure.object_name is None:
            qpos, qvel = exposure.moment.qpos.copy(), exposure.moment.qvel.copy()
            qpos[OBJECT_POS], qvel[OBJECT_VEL] = AWAY, 0.0
            return replace(exposure.moment, qpos=qpos, qvel=qvel)
        row, model = self._objects.names.index(exposure.object_name), self._renderer.model
        for name in GEOM_FIELDS:
            getattr(model, name)[self._geoms] = self._objects.fields[name][row]
        return exposure.moment

    def _smear(self, moment: Moment) -> float:
        """Return the largest motion of object and palms in the image during an exposure [px]."""
        times = self._cfg.exposure * np.array(((-0.5,), (0.5,)))
        ways = [
            chain.pose(torch.from_numpy(moment.qpos[carriers] + times * moment.qvel[carriers]))[0]
            for carriers, chain in self._chains
        ]
        ways.append(torch.from_numpy(moment.qpos[OBJECT_POS] + times * moment.qvel[OBJECT_VEL]))
        pixels, _ = project(self._camera, torch.stack(ways, dim=1))
        return float((pixels[1] - pixels[0]).norm(dim=-1).max())

    def _sensed(self, light: Float[np.ndarray, "num_pixels 3"]) -> UInt8[np.ndarray, "num_pixels 3"]:
        start = self._rng.integers(NOISE_LENGTH - light.size)
        deviation = np.sqrt(self._cfg.read_noise**2 + self._cfg.shot_noise * light)
        deviation *= self._noise[start : start + light.size].reshape(light.shape)
        light += deviation
        return np.clip(np.rint(light, out=light), 0.0, 255.0, out=light).astype(np.uint8)


def room_positions(
    room: mujoco.MjModel,
    moment: Moment,
    offset: float,
    bystanders: Callable[[float], Float[np.ndarray, " num_bystanders"]],
) -> Float[np.ndarray, " num_positions"]:
    """Return the positions of `build_room` at an offset from the middle of an exposure [s]."""
    qpos, qvel = room.qpos0.copy(), np.zeros(room.nv)
    qpos[: len(moment.qpos)], qvel[: len(moment.qvel)] = moment.qpos, moment.qvel
    mujoco.mj_integratePos(room, qpos, qvel, offset)
    qpos[len(moment.qpos) :] = bystanders(moment.time + offset)
    return qpos


def _without(room: mujoco.MjModel, is_left_out: Bool[np.ndarray, " num_geoms"]) -> mujoco.MjModel:
    other = copy.copy(room)
    other.geom_group[is_left_out] = UNDRAWN_GROUP
    return other
