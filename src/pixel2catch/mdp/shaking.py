"""A table that shakes, in the frame of the robot that stands on it.

The robot's base moves by b(t) = A d sin(2 pi f t + phase) with a random direction d. In the frame of the
base, the fictitious force -m b''(t) acts on the free object, and camera and thrower move by -b(t). The
inertial load of the robot is neglected. Source: ours, for tests of policies.
"""

from dataclasses import dataclass, replace
from math import pi
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.checks import Within
from pixel2catch.mdp.throws import Throw, random_directions
from pixel2catch.scene.constants import CONTROL_DT


@dataclass(frozen=True, kw_only=True)
class ShakeCfg:
    """How the table shakes."""

    #: Largest displacement [m]; 0 is a table that stands still, as in training.
    amplitude: Annotated[float, Within(0.0, 0.2)] = 0.0
    frequency: Annotated[float, Within(0.0, 50.0)] = 0.0  #: Frequency [Hz].


@dataclass(frozen=True, kw_only=True)
class Shake:
    """How the base moves in one episode of each environment; times are those of the episode [s]."""

    sine: Float[Tensor, "num_envs 3"]  #: A d cos(phase) [m].
    cosine: Float[Tensor, "num_envs 3"]  #: A d sin(phase) [m].
    rate: Float[Tensor, " num_envs"]  #: 2 pi f [rad/s].

    def displacement(self, time: Float[Tensor, "*times num_envs"]) -> Float[Tensor, "*times num_envs 3"]:
        """Return the displacement of the base [m]."""
        angle = (self.rate * time).unsqueeze(-1)
        return self.sine * torch.sin(angle) + self.cosine * torch.cos(angle)

    def velocity(self, time: Float[Tensor, "*times num_envs"]) -> Float[Tensor, "*times num_envs 3"]:
        """Return the velocity of the base [m/s]."""
        angle = (self.rate * time).unsqueeze(-1)
        return self.rate[:, None] * (self.sine * torch.cos(angle) - self.cosine * torch.sin(angle))

    def acceleration(self, time: Float[Tensor, "*times num_envs"]) -> Float[Tensor, "*times num_envs 3"]:
        """Return the acceleration of the base [m/s²]."""
        return -self.rate.square()[:, None] * self.displacement(time)

    def seen_from_base(self, throw: Throw) -> Throw:
        """Return a throw in the frame of the base; its aim stays in the laboratory's frame."""
        start, release = torch.zeros_like(throw.pos[:, 0]), throw.hover_steps * CONTROL_DT
        return replace(
            throw,
            pos=throw.pos - self.displacement(start),
            hover_vel=throw.hover_vel - self.velocity(start),
            lin_vel=throw.lin_vel - self.velocity(release),
        )


def sample_shake(cfg: ShakeCfg, num_envs: int, generator: torch.Generator) -> Shake | None:
    """Draw direction and phase, on the generator's device; None if the table stands still."""
    if not (cfg.amplitude and cfg.frequency):
        return None
    device = generator.device
    vector = cfg.amplitude * random_directions(num_envs, generator)
    phase = 2.0 * pi * torch.rand(num_envs, 1, generator=generator, device=device)
    return Shake(
        sine=vector * torch.cos(phase),
        cosine=vector * torch.sin(phase),
        rate=torch.full((num_envs,), 2.0 * pi * cfg.frequency, device=device),
    )
