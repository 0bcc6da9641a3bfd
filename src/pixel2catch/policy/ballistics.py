"""The flight of a thrown object from measured boxes: the most probable throw, with gravity as the scale.

A throw has seven parameters: position at release, peak height, the point in the plane of the catch height
through which it falls, and the time of release. Before the release the object is at rest. Their prior is that
of the task's ranges. The centres of the boxes decide; without gravity they would not give the distance.
"""

from math import sqrt

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pixel2catch.camera.level import LEVEL_CAMERA
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.mdp.throws import ThrowCfg, launch_velocity
from pixel2catch.scene.constants import CONTROL_DT, GRAVITY

CENTER_NOISE = 2.2
"""Standard deviation of a box centre [px]. Source: ours, edges that are up to 5 px off, and outlines."""
OUTLIER = 5.0  #: Deviation of a centre at which its weight is halved [standard deviations]. Source: ours.
MOTION = 12.0
"""Distance from the oldest box from which an object flies [px]. Source: ours, more than the noise of two."""
UNLIKELY = 2.0
"""Deviation of a parameter from the middle of its range at which the prior's weight is halved [standard
deviations of the range], so that boxes can show other throws. Source: ours."""
NUM_STEPS, NUM_PLAIN = 6, 2  #: Gauss-Newton steps, and those that weight all boxes alike. Source: ours.
LONGEST_STEP = 5.0  #: Largest change of a parameter in a step [standard deviations]. Source: ours.
TIME_STIFFNESS = 1e-3  #: Damping of the release time, which has no prior [1/step²]. Source: ours.
DIFFERENCE = 1e-4  #: Change of a parameter for a derivative [standard deviations]. Source: ours.
LEAST_RISE = 0.05  #: Least height of the peak over release and catch height [m]. Source: ours.


class BallisticFit(nn.Module):
    """The most probable flights under the ranges of a task's throws."""

    mean: Tensor
    scale: Tensor

    def __init__(self, throws: ThrowCfg) -> None:
        """Take mean and deviation of each range; a throw may pass the catch height anywhere in its range."""
        super().__init__()
        ranges = [throws.release_x, throws.release_y, throws.release_z]
        ranges += [throws.peak_z, throws.aim_x, throws.aim_y]
        deviations = [(high - low) / sqrt(12.0) for low, high in ranges]
        mean = [*((low + high) / 2.0 for low, high in ranges), 0.0]
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float64))
        self.register_buffer("scale", torch.tensor([*deviations, CONTROL_DT], dtype=torch.float64))
        self.catch_height = sum(throws.aim_z) / 2.0  #: Height at which a throw is to be caught [m].

    def forward(
        self,
        box: Float[Tensor, "num_envs num_boxes 4"],
        age: Float[Tensor, "num_envs num_boxes"],
        camera_pos: Float[Tensor, "num_envs 3"],
    ) -> tuple[Float[Tensor, "num_envs 3"], Float[Tensor, "num_envs 3"], Bool[Tensor, " num_envs"]]:
        """Return position [m] and velocity [m/s] of the object now, and whether it flies.

        Args:
            box: Boxes of the level camera, newest first [px].
            age: Their ages [control steps].
            camera_pos: Place of the camera [m].
        """
        center, time = 0.5 * (box[..., :2] + box[..., 2:]), -age * CONTROL_DT
        is_repeated = (box[:, 1:] == box[:, :-1]).all(-1)  # a history begins with one box, several times
        is_known = nn.functional.pad(~is_repeated, (1, 0), value=True).to(center)
        has_moved = torch.linalg.vector_norm(center - center[:, -1:], dim=-1) > MOTION
        first = (has_moved * torch.arange(1, age.shape[1] + 1, device=age.device)).amax(1)
        release = time.gather(1, (first[:, None] - 1).clamp(min=0)) - 0.5 * CONTROL_DT
        throw = torch.cat((self.mean[:-1].expand(len(age), 6), release), dim=-1)
        is_drawn = nn.functional.pad(torch.ones_like(self.mean[:-1]), (0, 1))
        changes = nn.functional.pad(DIFFERENCE * torch.diag(self.scale), (0, 0, 1, 0))
        for step in range(NUM_STEPS):
            seen = self._pixels(throw[:, None] + changes, time, camera_pos)
            error = (center - seen[:, 0]) / CENTER_NOISE
            slope = (seen[:, 1:] - seen[:, :1]) / (DIFFERENCE * CENTER_NOISE)
            weight = is_known
            if step >= NUM_PLAIN:
                weight = weight / (1.0 + error.square().sum(-1) / OUTLIER**2)
            weighted = (slope * weight[:, None, :, None]).flatten(2)
            away = (throw - self.mean) / self.scale
            prior = is_drawn / (1.0 + (away / UNLIKELY).square())
            damp = torch.diag_embed(prior + TIME_STIFFNESS * (1.0 - is_drawn))
            normal = weighted @ slope.flatten(2).transpose(1, 2) + damp
            down = (weighted @ error.flatten(1)[..., None])[..., 0] - prior * away
            change = torch.linalg.solve(normal, down).clamp(-LONGEST_STEP, LONGEST_STEP)
            throw = throw + self.scale * change
        pos, vel = self._states(throw, torch.zeros_like(time[:, :1]))
        return pos[:, 0], vel[:, 0], first > 0

    def _pixels(
        self,
        throw: Float[Tensor, "num_envs num_throws 7"],
        time: Float[Tensor, "num_envs num_boxes"],
        camera_pos: Float[Tensor, "num_envs 3"],
    ) -> Float[Tensor, "num_envs num_throws num_boxes 2"]:
        """Return where the level camera sees the objects of throws [px]."""
        several = throw.shape[1]
        pos, _ = self._states(throw.flatten(0, 1), time.repeat_interleave(several, 0))
        place = pos - camera_pos.repeat_interleave(several, 0)[:, None]
        return nominal_projection(LEVEL_CAMERA, place).pixels(place)[0].unflatten(0, (-1, several))

    def _states(
        self, throw: Float[Tensor, "n 7"], time: Float[Tensor, "n k"]
    ) -> tuple[Float[Tensor, "n k 3"], Float[Tensor, "n k 3"]]:
        """Return positions [m] and velocities [m/s] of throws at times [s]."""
        pos, height = throw[:, :3], torch.full_like(throw[:, :1], self.catch_height)
        peak = torch.maximum(throw[:, 3], pos[:, 2].clamp(min=self.catch_height) + LEAST_RISE)
        vel = launch_velocity(pos, torch.cat((throw[:, 4:6], height), dim=-1), peak)
        since = (time - throw[:, 6:]).clamp(min=0.0)[..., None]
        fall = pos.new_tensor((0.0, 0.0, -GRAVITY)) * since
        return pos[:, None] + (vel[:, None] + 0.5 * fall) * since, vel[:, None] + fall
