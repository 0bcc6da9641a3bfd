"""Throws as a real camera would film them, with the truth beside each image, to judge perception by.

A furnished room, a thrower, an exposure time and a sensor's noise. Needs OpenGL (`find_gl_backend`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.camera.image import Image
from pixel2catch.evaluation.protocol import RecordedThrow
from pixel2catch.perception.labels import Phase, Truth
from pixel2catch.perception.regions import window_of
from pixel2catch.rendering.camera import CameraCfg, Exposure, Moment, RoomCamera
from pixel2catch.rendering.room import Bystanders
from pixel2catch.robots.geometry import chain_of
from pixel2catch.scene.constants import CONTROL_DT, OBJECT_POS, OBJECT_VEL
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.workcells import find_workcell

LEAST_SPEED = 0.5  #: Speed from which an object flies [m/s].

NEAR_HAND = 0.25
"""From the palm to the object [m]; what was nearer once is near the hand from then on. Source: ours, the last
two images of a flight."""

LEAST_PIXELS = 6  #: Visible pixels of the object from which it can be found. Source: as the gate's.


@dataclass(frozen=True, kw_only=True)
class FilmCfg:
    """How throws are filmed."""

    scene: SceneCfg = field(default_factory=SceneCfg)  #: The scene of the simulation.
    camera: CameraCfg = field(default_factory=CameraCfg)  #: Exposure and noise.
    room: int = 0  #: Seed of the room's looks.
    num_empty: int = 40  #: Images of the room before there is an object.
    num_held: int = 15  #: Images of the object in the thrower's hand before the episode begins.
    #: Standard deviation of the joint positions that come with an image [rad]. Source: paper, Table I,
    #: observation noise.
    encoder_noise: float = 0.005


@dataclass(frozen=True, kw_only=True)
class LabelledImage:
    """One image and what it shows."""

    image: (
        Image  #: With the encoders' positions and the time since the release of the middle of its exposure.
    )
    box: Float[Tensor, "1 4"]  #: True box of the visible part of the object [px]; zeros if there is none.
    num_pixels: int  #: Pixels of this part.
    palm_distance: float  #: From the palm to the object's centre [m].


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
        self._cfg, self._object_name, self._rng = cfg, object_name, np.random.default_rng(seed)
        phase = float(self._rng.uniform(0.0, 2.0 * np.pi))
        self._bystanders = Bystanders(release_pos=release_pos, phase=phase)
        self._camera = RoomCamera(cfg.scene, seed, cfg.camera, room=cfg.room, shadows=True)

    def lead_in(self, start: Moment) -> Iterator[LabelledImage]:
        """Yield images of the room, then of the object in the hand, up to the one before the start.

        Robot and object wait in the position of the start, the beginning of the episode.
        """
        for left in range(self._cfg.num_empty + self._cfg.num_held, 0, -1):
            moment = replace(start, qvel=np.zeros_like(start.qvel), time=start.time - left * CONTROL_DT)
            yield self.shot(moment, is_empty=left > self._cfg.num_held)

    def shot(self, moment: Moment, *, is_empty: bool = False) -> LabelledImage:
        """Take an image, with the object or as if there were none."""
        name = None if is_empty else self._object_name
        exposure = Exposure(moment=moment, object_name=name, thrower=self._bystanders.joint_pos)
        mask = self._camera.object_mask(exposure)
        rows, columns = window_of(mask)
        box = torch.tensor([[columns.start, rows.start, columns.stop, rows.stop]]).float()
        workcell = find_workcell(self._cfg.scene.workcell)
        joint_pos = moment.qpos[: len(workcell.joints)]
        arm = joint_pos[None, workcell.palms[0].carriers]
        palm_pos, _ = chain_of(workcell, workcell.palms[0]).pose(torch.from_numpy(arm))
        pixels, noise = self._camera.image(exposure), self._rng.standard_normal(len(joint_pos))
        measured = joint_pos + self._cfg.encoder_noise * noise
        return LabelledImage(
            image=Image(pixels=pixels, stamp=moment.time, joint_pos=measured),
            box=box,
            num_pixels=int(mask.sum()),
            palm_distance=float(np.linalg.norm(moment.qpos[OBJECT_POS] - palm_pos[0].numpy())),
        )

    def __enter__(self) -> "ThrowFilm":
        """Return the film itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Free the drawing context."""
        self._camera.__exit__(*exception)


def moments(throw: RecordedThrow) -> list[Moment]:
    """The states of a throw until the success or the end, with their times since the release."""
    qpos, qvel = throw.qpos[: throw.num_untested], throw.qvel[: throw.num_untested]
    flying = np.flatnonzero(np.linalg.norm(qvel[:, OBJECT_VEL], axis=-1) > LEAST_SPEED)
    release = int(flying[0]) if len(flying) else len(qvel)
    return [Moment(qpos=qpos[i], qvel=qvel[i], time=(i - release) * CONTROL_DT) for i in range(len(qpos))]


def truths(shots: Sequence[LabelledImage]) -> list[Truth]:
    """What the images of a film show."""
    found, is_near = [], False
    for shot in shots:
        is_near = is_near or shot.palm_distance < NEAR_HAND
        phase: Phase = "near the hand" if is_near else "flight" if shot.image.stamp > 0.0 else "held"
        xmin, ymin, xmax, ymax = shot.box[0].tolist()
        box = (xmin, ymin, xmax, ymax) if shot.num_pixels >= LEAST_PIXELS else None
        found.append(Truth(phase=phase, box=box))
    return found
