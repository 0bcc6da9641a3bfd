"""The flight of a thrown object from its boxes: the most probable throw, with gravity as the scale.

Parameters of a throw: position at release, peak height, the point in the plane of the catch height through
which it falls, and the time of release, before which the object is at rest.
"""

from math import sqrt

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from pixel2catch.batches import Flags, Vectors
from pixel2catch.camera.boxes import center_and_size
from pixel2catch.camera.level import LEVEL_CAMERA
from pixel2catch.camera.pinhole import project
from pixel2catch.mdp.throws import ThrowCfg, launch_velocity
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY

CENTER_NOISE = 2.2  #: Deviation of a box centre [px]. Source: ours, edges that are up to 5 px off.
OUTLIER = 5.0  #: Deviation of a centre at which its weight is halved [of `CENTER_NOISE`]. Source: ours.
UNLIKELY = 2.0
"""Deviation of a parameter at which the prior's weight is halved [deviations of its range]. Source: ours."""
MOTION = 12.0  #: Distance from the oldest centre from which an object flies [px]. Source: ours.
NUM_STEPS, NUM_PLAIN = 6, 2  #: Gauss-Newton steps, and those that weight all boxes alike. Source: ours.
DIFFERENCE = 1e-4  #: Change of a parameter for a derivative [deviations]. Source: ours.
TIME_STIFFNESS = 1e-3  #: Damping of the release time, which has no prior [1/step²]. Source: ours.
LEAST_RISE = 0.05  #: Least height of the peak over release and catch height [m]. Source: ours.


class BallisticFit:
    """Fits throws to boxes; the ranges of a task's throws are the prior."""

    def __init__(self, throws: ThrowCfg) -> None:
        """Take middle and deviation of each range."""
        ranges = (throws.release_x, throws.release_y, throws.release_z)
        ranges += (throws.peak_z, throws.aim_x, throws.aim_y)
        middle, deviation = zip(*(((a + b) / 2.0, (b - a) / sqrt(12.0)) for a, b in ranges), strict=True)
        self._middle = torch.tensor([*middle, 0.0], dtype=torch.float64)
        self._scale = torch.tensor([*deviation, CONTROL_DT], dtype=torch.float64)
        self._is_drawn = torch.tensor([1.0] * len(ranges) + [0.0], dtype=torch.float64)
        self.catch_height = sum(throws.aim_z) / 2.0  #: Middle of the task's catch heights [m].

    def __call__(
        self,
        box: Float[Tensor, "num_envs num_boxes 4"],
        age: Float[Tensor, "num_envs num_boxes"],
        camera_pos: Vectors,
    ) -> tuple[Vectors, Vectors, Flags]:
        """Return the object's position [m] and velocity [m/s] now, and whether it flies.

        Boxes are those of the level camera [px], newest first, with their ages [control steps].
        """
        (center, _), time = center_and_size(box), -age * CONTROL_DT
        is_repeated = (box[:, 1:] == box[:, :-1]).all(-1)  # a history begins with one box, several times
        is_known = pad(~is_repeated, (1, 0), value=True).to(center)
        has_moved = torch.linalg.vector_norm(center - center[:, -1:], dim=-1) > MOTION
        first = (has_moved * torch.arange(1, age.shape[1] + 1)).amax(1)
        release = time.gather(1, (first[:, None] - 1).clamp(min=0)) - 0.5 * CONTROL_DT
        throw = torch.cat((self._middle[:-1].expand(len(age), -1), release), dim=-1)
        changes = pad(DIFFERENCE * torch.diag(self._scale), (0, 0, 1, 0))
        for step in range(NUM_STEPS):
            seen = self._pixels(throw[:, None] + changes, time, camera_pos)
            error = (center - seen[:, 0]) / CENTER_NOISE
            slope = (seen[:, 1:] - seen[:, :1]) / (DIFFERENCE * CENTER_NOISE)
            outliers = error.square().sum(-1) / OUTLIER**2 if step >= NUM_PLAIN else 0.0
            weighted = (slope * (is_known / (1.0 + outliers))[:, None, :, None]).flatten(2)
            away = (throw - self._middle) / self._scale
            prior = self._is_drawn / (1.0 + (away / UNLIKELY).square())
            damp = torch.diag_embed(prior + TIME_STIFFNESS * (1.0 - self._is_drawn))
            normal = weighted @ slope.flatten(2).transpose(1, 2) + damp
            down = (weighted @ error.flatten(1)[..., None])[..., 0] - prior * away
            throw = throw + self._scale * torch.linalg.solve(normal, down).clamp(-5.0, 5.0)
        pos, vel = self._states(throw, torch.zeros_like(time[:, :1]))
        return pos[:, 0], vel[:, 0], first > 0

    def _pixels(self, throw: Tensor, time: Tensor, camera_pos: Vectors) -> Tensor:
        """Return where the level camera sees several throws of each environment at its times [px]."""
        several = throw.shape[1]
        pos, _ = self._states(throw.flatten(0, 1), time.repeat_interleave(several, 0))
        place = pos - camera_pos.repeat_interleave(several, 0)[:, None]
        return project(LEVEL_CAMERA, place)[0].unflatten(0, (-1, several))

    def _states(self, throw: Float[Tensor, "n 7"], time: Float[Tensor, "n k"]) -> tuple[Tensor, Tensor]:
        """Return positions [m] and velocities [m/s] of throws at times [s]."""
        pos, height = throw[:, :3], torch.full_like(throw[:, :1], self.catch_height)
        peak = torch.maximum(throw[:, 3], pos[:, 2].clamp(min=self.catch_height) + LEAST_RISE)
        vel = launch_velocity(pos, torch.cat((throw[:, 4:6], height), dim=-1), peak)
        since = (time - throw[:, 6:]).clamp(min=0.0)[..., None]
        fall = since * pos.new_tensor((0.0, 0.0, -GRAVITY))
        return pos[:, None] + (vel[:, None] + 0.5 * fall) * since, vel[:, None] + fall
