"""The film of one throw: the empty room, the object held out, its flight; every image with the truth."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pixel2catch.camera.boxes import box_of_mask
from pixel2catch.evaluation.rendered.bystanders import Bystanders
from pixel2catch.evaluation.rendered.camera import ARM, OBJECT, ROBOT, CameraCfg, Moment, RoomCamera
from pixel2catch.evaluation.rendered.room import build_room
from pixel2catch.robot.constants import CONTROL_DT
from pixel2catch.robot.kinematics import palm_pose
from pixel2catch.robot.scene import SceneCfg

AWAY = (0.0, 0.0, -5.0)
"""Where an object is that is not in the room: under the floor [m]."""


@dataclass(frozen=True, kw_only=True)
class FilmCfg:
    """How throws are filmed.

    Attributes:
        scene: The scene of the simulation.
        camera: Exposure and noise.
        room: Seed of the room's looks.
        num_empty: Images of the room before there is an object.
        num_held: Images of the object in the thrower's hand before the episode begins.
        encoder_noise: Standard deviation of the joint positions that come with an image [rad]. Source: paper,
            Table I, observation noise.
    """

    scene: SceneCfg = field(default_factory=SceneCfg)
    camera: CameraCfg = field(default_factory=CameraCfg)
    room: int = 0
    num_empty: int = 40
    num_held: int = 15
    encoder_noise: float = 0.005


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One image and what it shows.

    Attributes:
        image: Red, green, blue; upper row first.
        joint_pos: What the encoders say in the middle of the exposure [rad].
        time: The middle of the exposure, since the release [s].
        box: The true box of the visible part of the object then [px]; zeros if there is none.
        num_pixels: Pixels of this part.
        palm_distance: From the palm to the object's centre [m].
    """

    image: UInt8[np.ndarray, "height width 3"]
    joint_pos: Float[np.ndarray, " num_joints"]
    time: float
    box: Float[Tensor, "1 4"]
    num_pixels: int
    palm_distance: float


class ThrowFilm:
    """Films one throw; close it, or use it as a context manager."""

    def __init__(
        self, cfg: FilmCfg, object_name: str, release_pos: Float[np.ndarray, "3"], seed: int
    ) -> None:
        """Furnish the room and place the thrower.

        Args:
            cfg: How to film.
            object_name: What is thrown.
            release_pos: Where it is held before [m].
            seed: Of noise and of the bystanders' swing.

        Raises:
            DeviceUnavailableError: If no OpenGL back end works.
        """
        self._cfg, self._rng = cfg, np.random.default_rng(seed)
        bystanders = Bystanders(release_pos=release_pos, phase=float(self._rng.uniform(0.0, 2.0 * np.pi)))
        self._room = build_room(cfg.scene, object_name, cfg.room)
        self._camera = RoomCamera(self._room, bystanders, cfg.camera, seed)

    def lead_in(self, start: Moment, num_empty: int) -> Iterator[Shot]:
        """Yield images of the room, then of the object in the hand, up to the one before the start.

        Args:
            start: The beginning of the episode; robot and object wait in this position.
            num_empty: Images without the object.
        """
        for left in range(num_empty + self._cfg.num_held, 0, -1):
            moment = replace(start, qvel=np.zeros_like(start.qvel), time=start.time - left * CONTROL_DT)
            yield self.shot(moment if left <= self._cfg.num_held else without_object(moment))

    def shot(self, moment: Moment) -> Shot:
        """Take an image."""
        mask = self._camera.object_mask(moment)
        box, _ = box_of_mask(torch.from_numpy(mask)[None])
        joint_pos = moment.qpos[ROBOT]
        palm_pos, _ = palm_pose(torch.from_numpy(moment.qpos[None, ARM]))
        return Shot(
            image=self._camera.image(moment),
            joint_pos=joint_pos + self._cfg.encoder_noise * self._rng.standard_normal(len(joint_pos)),
            time=moment.time,
            box=box,
            num_pixels=int(mask.sum()),
            palm_distance=float(np.linalg.norm(moment.qpos[OBJECT] - palm_pos[0].numpy())),
        )

    def close(self) -> None:
        """Free the drawing context."""
        self._camera.close()

    def __enter__(self) -> "ThrowFilm":
        """Return the film itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the film."""
        self.close()


def without_object(moment: Moment) -> Moment:
    """The same moment in a room without the object."""
    qpos = moment.qpos.copy()
    qpos[OBJECT] = AWAY
    return replace(moment, qpos=qpos)
