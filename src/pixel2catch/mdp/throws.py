"""Throws: where the object hovers, and the flight that follows, through air or none.

Source: release, unless a line says otherwise.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pixel2catch.checks import Amount, InOrder, Range, Within
from pixel2catch.device_constants import constant
from pixel2catch.scene.constants import GRAVITY

Depth = Annotated[Range, Within(0.05, 10.0)]  #: Along x [m].
Width = Annotated[Range, Within(-5.0, 5.0)]  #: Along y [m].
Height = Annotated[Range, Within(0.05, 5.0)]  #: Above the floor [m].


@dataclass(frozen=True, kw_only=True)
class ThrowCfg:
    """Ranges of uniformly drawn throws, world frame [m]."""

    release_x: Depth = (2.4, 2.9)  #: Where the object is released, x.
    release_y: Width = (-0.3, 0.3)  #: Likewise, y.
    release_z: Height = (0.75, 0.85)  #: Likewise, z.
    aim_x: Depth = (0.65, 0.85)  #: Where the path comes down through the catch height, x.
    aim_y: Width = (-0.35, 0.35)  #: Likewise, y.
    aim_z: Height = (0.9, 1.1)  #: The catch height.
    peak_z: Height = (1.6, 1.9)  #: Highest point of the path.
    clearance: Annotated[float, Within(0.01, 3.0)] = 0.2  #: Least height of the peak over release and aim.
    #: Control steps that the object hovers before it flies, first and last.
    hover_steps: Annotated[tuple[int, int], InOrder(), Within(1, 900)] = (5, 19)
    #: Standard deviation of a relative error of the speed at release. This and what follows is 0 in training
    #: (ours, for tests of policies).
    speed_deviation: Annotated[Amount, Within(0.0, 0.5)] = 0.0
    #: Standard deviation of the errors of its elevation and of its azimuth [rad].
    angle_deviation: Annotated[Amount, Within(0.0, 0.8)] = 0.0
    #: Largest angular speed of the object, uniform, about a random axis [rad/s].
    spin: Annotated[float, Within(0.0, 200.0)] = 0.0


@dataclass(frozen=True, kw_only=True)
class Throw:
    """One throw per environment."""

    pos: Float[Tensor, "num_envs 3"]  #: Release position [m].
    quat: Float[Tensor, "num_envs 4"]  #: Orientation, uniform over all rotations, (w, x, y, z).
    hover_vel: Float[Tensor, "num_envs 3"]  #: Velocity before the release [m/s]; only that of a moving frame.
    lin_vel: Float[Tensor, "num_envs 3"]  #: Velocity at release [m/s].
    ang_vel: Float[Tensor, "num_envs 3"]  #: Angular velocity at release, frame of the object [rad/s].
    aim: Float[Tensor, "num_envs 3"]  #: Where the path is meant to come down through the catch height [m].
    hover_steps: Int[Tensor, " num_envs"]  #: Control steps before the release.

    def flight_time(self) -> Float[Tensor, " num_envs"]:
        """Time from the release until the path comes down through the catch height, but for drag [s]."""
        return flight_time(self.lin_vel, self.aim[:, 2] - self.pos[:, 2])


def sample_throws(
    cfg: ThrowCfg,
    num_envs: int,
    generator: torch.Generator,
    drag: Float[Tensor, " num_envs"] | None = None,
) -> Throw:
    """Draw throws on the generator's device.

    The thrower makes up for `drag`: deceleration by air over the square of the speed [1/m].
    """
    device = generator.device
    ranges = (cfg.release_x, cfg.release_y, cfg.release_z, cfg.aim_x, cfg.aim_y, cfg.aim_z, cfg.peak_z)
    draws = uniform(ranges, num_envs, generator)
    pos, aim, peak = draws[:, 0:3], draws[:, 3:6], draws[:, 6]
    quat = torch.nn.functional.normalize(torch.randn(num_envs, 4, generator=generator, device=device), dim=-1)
    first, last = cfg.hover_steps
    hover_steps = torch.randint(first, last + 1, (num_envs,), generator=generator, device=device)
    peak = torch.maximum(peak, cfg.clearance + torch.maximum(pos[:, 2], aim[:, 2]))
    lin_vel, still = launch_velocity(pos, aim, peak), torch.zeros_like(pos)
    if drag is not None:
        lin_vel = velocity_through_air(pos, aim, lin_vel, drag)
    return Throw(
        pos=pos,
        quat=quat,
        hover_vel=still,
        lin_vel=_released(cfg, lin_vel, generator),
        ang_vel=_spin(cfg.spin, num_envs, generator) if cfg.spin else still,
        aim=aim,
        hover_steps=hover_steps,
    )


def _released(
    cfg: ThrowCfg, lin_vel: Float[Tensor, "num_envs 3"], generator: torch.Generator
) -> Float[Tensor, "num_envs 3"]:
    """The intended velocity with the thrower's errors of speed, elevation and azimuth [m/s]."""
    if not (cfg.speed_deviation or cfg.angle_deviation):
        return lin_vel
    num_envs = len(lin_vel)
    error = torch.randn(num_envs, 3, generator=generator, device=lin_vel.device)
    angle_deviation = drawn(cfg.angle_deviation, num_envs, generator)
    faster = drawn(cfg.speed_deviation, num_envs, generator) * error[:, 0]
    speed = torch.linalg.vector_norm(lin_vel, dim=-1) * (1.0 + faster)
    along = torch.linalg.vector_norm(lin_vel[:, :2], dim=-1)
    elevation = torch.atan2(lin_vel[:, 2], along) + angle_deviation * error[:, 1]
    azimuth = torch.atan2(lin_vel[:, 1], lin_vel[:, 0]) + angle_deviation * error[:, 2]
    level = speed * torch.cos(elevation)
    return torch.stack(
        (level * torch.cos(azimuth), level * torch.sin(azimuth), speed * torch.sin(elevation)), dim=-1
    )


def _spin(largest: float, num_envs: int, generator: torch.Generator) -> Float[Tensor, "num_envs 3"]:
    """Angular velocities about random axes [rad/s]."""
    speed = largest * torch.rand(num_envs, 1, generator=generator, device=generator.device)
    return speed * random_directions(num_envs, generator)


def launch_velocity(
    pos: Float[Tensor, "num_envs 3"], aim: Float[Tensor, "num_envs 3"], peak: Float[Tensor, " num_envs"]
) -> Float[Tensor, "num_envs 3"]:
    """Velocity at `pos` of the path that peaks at height `peak` and comes down through `aim` [m/s]."""
    rise = torch.sqrt(2.0 * (peak - pos[:, 2]) / GRAVITY)
    fall = torch.sqrt(2.0 * (peak - aim[:, 2]) / GRAVITY)
    horizontal = (aim[:, :2] - pos[:, :2]) / (rise + fall)[:, None]
    return torch.cat((horizontal, (GRAVITY * rise)[:, None]), dim=-1)


def drawn(amount: Amount, num_envs: int, generator: torch.Generator) -> Float[Tensor, " num_envs"]:
    """The amount of every episode, on the generator's device; a number draws nothing."""
    if isinstance(amount, tuple):
        return uniform((amount,), num_envs, generator)[:, 0]
    return torch.full((num_envs,), float(amount), device=generator.device)


def uniform(
    ranges: tuple[Range, ...], num_envs: int, generator: torch.Generator
) -> Float[Tensor, "num_envs k"]:
    """Independent uniform draws, one column per range, on the generator's device."""
    lower, upper = constant(ranges, generator.device).T
    draws = torch.rand(num_envs, len(ranges), generator=generator, device=generator.device)
    return lower + (upper - lower) * draws


def random_directions(num_envs: int, generator: torch.Generator) -> Float[Tensor, "num_envs 3"]:
    """Unit vectors, uniform over all directions, on the generator's device."""
    normal = torch.randn(num_envs, 3, generator=generator, device=generator.device)
    return torch.nn.functional.normalize(normal, dim=-1)


NUM_STEPS = 16  #: Steps of the midpoint rule in a flight. Source: ours, a millimetre.

NUM_CORRECTIONS = 4
"""How often the aim is corrected; each leaves less than a third of the error before. Source: ours."""


def flight_time(
    lin_vel: Float[Tensor, "num_envs 3"], height: Float[Tensor, " num_envs"]
) -> Float[Tensor, " num_envs"]:
    """Time until an object without drag comes down through this height over its release [s]."""
    up = lin_vel[:, 2]
    return (up + torch.sqrt(torch.clamp(up.square() - 2.0 * GRAVITY * height, min=0.0))) / GRAVITY


def velocity_through_air(
    pos: Float[Tensor, "num_envs 3"],
    aim: Float[Tensor, "num_envs 3"],
    lin_vel: Float[Tensor, "num_envs 3"],
    drag: Float[Tensor, " num_envs"],
) -> Float[Tensor, "num_envs 3"]:
    """Velocity at release that leads to the aim in spite of the air [m/s].

    The object arrives after the time that it would take without air.

    Args:
        pos: Where it is released [m].
        aim: Where it shall come down [m].
        lin_vel: The velocity that leads there without air [m/s].
        drag: Deceleration over the square of the speed [1/m].
    """
    duration = flight_time(lin_vel, aim[:, 2] - pos[:, 2])[:, None]
    for _ in range(NUM_CORRECTIONS):
        missed = aim - flight_path(pos, lin_vel, drag, duration[:, 0])[-1]
        lin_vel = lin_vel + missed / duration
    return lin_vel


def flight_path(
    pos: Float[Tensor, "num_envs 3"],
    lin_vel: Float[Tensor, "num_envs 3"],
    drag: Float[Tensor, " num_envs"],
    duration: Float[Tensor, " num_envs"],
) -> Float[Tensor, "num_points num_envs 3"]:
    """Points of a flight through air from the release on, evenly spread over the time of the flight [m].

    Args:
        pos: Where the object is released [m].
        lin_vel: Its velocity there [m/s].
        drag: Deceleration over the square of the speed [1/m].
        duration: Time of the flight [s].
    """
    step, path = duration[:, None] / NUM_STEPS, [pos]
    for _ in range(NUM_STEPS):
        middle = lin_vel + 0.5 * step * _acceleration(lin_vel, drag[:, None])
        path.append(path[-1] + step * middle)
        lin_vel = lin_vel + step * _acceleration(middle, drag[:, None])
    return torch.stack(path)


def sample_paths(cfg: ThrowCfg, num_throws: int, seed: int = 0) -> Float[Tensor, "num_throws num_points 3"]:
    """Points on drawn flights without air, from the release to the aim [m]."""
    throw = sample_throws(cfg, num_throws, torch.Generator().manual_seed(seed))
    path = flight_path(throw.pos, throw.lin_vel, torch.zeros(num_throws), throw.flight_time())
    return path.transpose(0, 1).double()


def _acceleration(lin_vel: Tensor, drag: Tensor) -> Tensor:
    """Drag and gravity [m/s²]."""
    acceleration = -drag * torch.linalg.vector_norm(lin_vel, dim=-1, keepdim=True) * lin_vel
    acceleration[:, 2] -= GRAVITY
    return acceleration
