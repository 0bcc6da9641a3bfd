"""A camera with an exposure time and a noisy sensor."""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from pixel2catch.camera.pinhole import project
from pixel2catch.evaluation.rendered.bystanders import Bystanders
from pixel2catch.evaluation.rendering import RGB_VIEW, Renderer
from pixel2catch.robot.constants import ARM_JOINTS, JOINTS, RGB_CAMERA
from pixel2catch.robot.kinematics import palm_pose

ARM, ROBOT = slice(len(ARM_JOINTS)), slice(len(JOINTS))
OBJECT = slice(len(JOINTS), len(JOINTS) + 3)
"""Where the arm, the robot and the object's position or linear velocity are in `qpos` and `qvel`."""


@dataclass(frozen=True, kw_only=True)
class CameraCfg:
    """What the camera does to an image.

    Attributes:
        exposure: Time in which an image gathers light [s]. Source: ours, short for a room, as one sets it to
            film throws; the fastest objects pass 15 px in it.
        part_length: Furthest that object and palm move between two of the pictures that are averaged over the
            exposure [px]. Source: ours, less than half an object.
        read_noise: Standard deviation of the noise in the dark [levels]. Source: ours.
        shot_noise: Variance that light adds [levels²] per level. Source: ours; with the other 3 levels at
            mid grey.
    """

    exposure: float = 0.008
    part_length: float = 4.0
    read_noise: float = 1.5
    shot_noise: float = 0.05


@dataclass(frozen=True, kw_only=True)
class Moment:
    """What the camera looks at, in the middle of the exposure.

    Attributes:
        qpos: Positions of the simulation: robot, then object.
        qvel: Its velocities, taken as constant during the exposure.
        time: Time since the release [s], negative before.
    """

    qpos: Float[np.ndarray, " nq"]
    qvel: Float[np.ndarray, " nv"]
    time: float


class RoomCamera:
    """Films one throw in a room; close it, or use it as a context manager."""

    def __init__(self, room: mujoco.MjModel, bystanders: Bystanders, cfg: CameraCfg, seed: int) -> None:
        """Open the drawing context.

        Args:
            room: From `build_room`.
            bystanders: How they move.
            cfg: The camera.
            seed: Of the sensor's noise.

        Raises:
            DeviceUnavailableError: If no OpenGL back end works.
        """
        self._room, self._bystanders, self._cfg = room, bystanders, cfg
        self._rng = np.random.default_rng(seed)
        self._renderer = Renderer(room, RGB_VIEW)

    def image(self, moment: Moment) -> UInt8[np.ndarray, "height width 3"]:
        """The image, with motion blur and noise."""
        pictures = [self._renderer.image(self._qpos(moment, each)) for each in part_times(moment, self._cfg)]
        light = np.mean(pictures, axis=0, dtype=np.float32)
        deviation = np.sqrt(self._cfg.read_noise**2 + self._cfg.shot_noise * light)
        noise = self._rng.standard_normal(light.shape, dtype=np.float32)
        return np.clip(np.rint(light + deviation * noise), 0, 255).astype(np.uint8)

    def object_mask(self, moment: Moment) -> Bool[np.ndarray, "height width"]:
        """Which pixels show the object in the middle of the exposure."""
        return self._renderer.object_mask(self._qpos(moment, 0.0))

    def close(self) -> None:
        """Free the drawing context."""
        self._renderer.close()

    def __enter__(self) -> "RoomCamera":
        """Return the camera itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the camera."""
        self.close()

    def _qpos(self, moment: Moment, offset: float) -> Float[np.ndarray, " num_positions"]:
        """All positions of the room so long after the middle of the exposure [s]."""
        return room_positions(self._room, moment, offset, self._bystanders.joint_pos)


def part_times(moment: Moment, cfg: CameraCfg) -> Float[np.ndarray, " num_parts"]:
    """When the pictures are taken that are averaged over an exposure, from its middle [s]."""
    num_parts = max(ceil(_smear(moment, cfg.exposure) / cfg.part_length), 1)
    return cfg.exposure * ((np.arange(num_parts) + 0.5) / num_parts - 0.5)


def room_positions(
    room: mujoco.MjModel,
    moment: Moment,
    offset: float,
    bystanders: Callable[[float], Float[np.ndarray, " num_bystanders"]],
) -> Float[np.ndarray, " num_positions"]:
    """All positions of the room so long after the middle of an exposure.

    Args:
        room: From `build_room`.
        moment: The middle of the exposure.
        offset: Time from there [s].
        bystanders: Positions of their joints at a time.
    """
    qpos, qvel = room.qpos0.copy(), np.zeros(room.nv)
    qpos[: len(moment.qpos)], qvel[: len(moment.qvel)] = moment.qpos, moment.qvel
    mujoco.mj_integratePos(room, qpos, qvel, offset)
    qpos[len(moment.qpos) :] = bystanders(moment.time + offset)
    return qpos


def _smear(moment: Moment, exposure: float) -> float:
    """How far object and palm move in the image during an exposure, the farther of the two [px]."""
    times = exposure * np.array(((-0.5,), (0.5,)))
    palm_pos, _ = palm_pose(torch.from_numpy(moment.qpos[ARM] + times * moment.qvel[ARM]))
    object_pos = torch.from_numpy(moment.qpos[OBJECT] + times * moment.qvel[OBJECT])
    pixels, _ = project(RGB_CAMERA, torch.stack((palm_pos, object_pos), dim=1))
    return float((pixels[1] - pixels[0]).norm(dim=-1).max())
