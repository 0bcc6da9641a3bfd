"""Throws: where the object hovers, and the ballistic flight that follows.

Source: release, unless a line says otherwise.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

GRAVITY = 9.81
"""Standard value, as MuJoCo's default [m/s^2]."""

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class ThrowCfg:
    """Ranges of uniformly drawn throws, world frame [m].

    Attributes:
        release_x: Where the object is released, x.
        release_y: Likewise, y.
        release_z: Likewise, z.
        aim_x: Where the path comes down through the catch height, x.
        aim_y: Likewise, y.
        aim_z: The catch height.
        peak_z: Highest point of the path.
        clearance: Least height of the peak over release and aim.
        hover_steps: Control steps that the object hovers before it flies, first and last.
    """

    release_x: Range = (2.4, 2.9)
    release_y: Range = (-0.3, 0.3)
    release_z: Range = (0.75, 0.85)
    aim_x: Range = (0.65, 0.85)
    aim_y: Range = (-0.35, 0.35)
    aim_z: Range = (0.9, 1.1)
    peak_z: Range = (1.6, 1.9)
    clearance: float = 0.2
    hover_steps: tuple[int, int] = (5, 19)


@dataclass(frozen=True, kw_only=True)
class Throw:
    """One throw per environment.

    Attributes:
        pos: Release position [m].
        quat: Orientation, uniform over all rotations, (w, x, y, z).
        lin_vel: Velocity at release [m/s].
        aim: Where the path comes down through the catch height [m].
        hover_steps: Control steps before the release.
    """

    pos: Float[Tensor, "num_envs 3"]
    quat: Float[Tensor, "num_envs 4"]
    lin_vel: Float[Tensor, "num_envs 3"]
    aim: Float[Tensor, "num_envs 3"]
    hover_steps: Int[Tensor, " num_envs"]


def sample_throws(cfg: ThrowCfg, num_envs: int, generator: torch.Generator) -> Throw:
    """Draw throws on the generator's device."""
    device = generator.device
    ranges = (cfg.release_x, cfg.release_y, cfg.release_z, cfg.aim_x, cfg.aim_y, cfg.aim_z, cfg.peak_z)
    draws = uniform(ranges, num_envs, generator)
    pos, aim, peak = draws[:, 0:3], draws[:, 3:6], draws[:, 6]
    quat = torch.nn.functional.normalize(torch.randn(num_envs, 4, generator=generator, device=device), dim=-1)
    first, last = cfg.hover_steps
    hover_steps = torch.randint(first, last + 1, (num_envs,), generator=generator, device=device)
    return Throw(
        pos=pos,
        quat=quat,
        lin_vel=launch_velocity(
            pos, aim, torch.maximum(peak, cfg.clearance + torch.maximum(pos[:, 2], aim[:, 2]))
        ),
        aim=aim,
        hover_steps=hover_steps,
    )


def launch_velocity(
    pos: Float[Tensor, "num_envs 3"], aim: Float[Tensor, "num_envs 3"], peak: Float[Tensor, " num_envs"]
) -> Float[Tensor, "num_envs 3"]:
    """Velocity at `pos` of the path that peaks at height `peak` and comes down through `aim` [m/s]."""
    rise = torch.sqrt(2.0 * (peak - pos[:, 2]) / GRAVITY)
    fall = torch.sqrt(2.0 * (peak - aim[:, 2]) / GRAVITY)
    horizontal = (aim[:, :2] - pos[:, :2]) / (rise + fall)[:, None]
    return torch.cat((horizontal, (GRAVITY * rise)[:, None]), dim=-1)


def uniform(
    ranges: tuple[Range, ...], num_envs: int, generator: torch.Generator
) -> Float[Tensor, "num_envs k"]:
    """Independent uniform draws, one column per range, on the generator's device."""
    lower, width = _bounds(ranges, generator.device)
    return lower + width * torch.rand(num_envs, len(ranges), generator=generator, device=generator.device)


@lru_cache(maxsize=32)
def _bounds(
    ranges: tuple[Range, ...], device: torch.device
) -> tuple[Float[Tensor, " k"], Float[Tensor, " k"]]:
    """Lower bounds and widths of ranges, copied to the device once."""
    bounds = torch.tensor(ranges, dtype=torch.float32, device=device)
    return bounds[:, 0], bounds[:, 1] - bounds[:, 0]
