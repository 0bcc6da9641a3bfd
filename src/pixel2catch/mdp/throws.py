"""Throws: where the object hovers, and its flight, with or without air.

Source: release, unless a line has another source.
"""

from dataclasses import dataclass
from math import tan
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.batches import Counts, Quaternions, Scalars, Vectors
from pixel2catch.checks import IN_ORDER, Amount, Range, Within
from pixel2catch.devices import uniform
from pixel2catch.errors import InvalidValueError
from pixel2catch.scene.constants import GRAVITY

Depth = Annotated[Range, Within(0.05, 10.0)]  #: Along x [m].
Width = Annotated[Range, Within(-5.0, 5.0)]  #: Along y [m].
Height = Annotated[Range, Within(0.05, 5.0)]  #: Above the floor [m].


@dataclass(frozen=True, kw_only=True)
class ThrowCfg:
    """Ranges of uniformly drawn throws, world frame [m]."""

    release_x: Depth = (2.4, 2.9)  #: Release position.
    release_y: Width = (-0.3, 0.3)
    release_z: Height = (0.75, 0.85)
    aim_x: Depth = (0.65, 0.85)  #: Where the path falls through the catch height.
    aim_y: Width = (-0.35, 0.35)
    aim_z: Height = (0.9, 1.1)  #: The catch height.
    peak_z: Height = (1.6, 1.9)  #: Highest point of the path.
    clearance: Annotated[float, Within(0.01, 3.0)] = 0.2  #: Least height of the peak over release and aim.
    #: Elevation at release below which the peak is raised [rad] (ours; paper: none).
    least_elevation: Annotated[float, Within(0.0, 1.4)] = 0.0
    #: Control steps that the object hovers before it flies, first and last.
    hover_steps: Annotated[tuple[int, int], IN_ORDER, Within(1, 900)] = (5, 19)
    #: Standard deviation of the relative error of the speed at release (ours; paper: no errors, no spin).
    speed_deviation: Annotated[Amount, Within(0.0, 0.5)] = 0.0
    #: Standard deviation of the errors of its elevation and azimuth [rad].
    angle_deviation: Annotated[Amount, Within(0.0, 0.8)] = 0.0
    #: Largest angular speed of the object about a random axis [rad/s].
    spin: Annotated[float, Within(0.0, 200.0)] = 0.0


@dataclass(frozen=True, kw_only=True)
class Throw:
    """One throw per environment."""

    pos: Vectors  #: Release position [m].
    quat: Quaternions  #: Orientation, uniform over all rotations, (w, x, y, z).
    lin_vel: Vectors  #: Velocity at release [m/s].
    ang_vel: Vectors  #: Angular velocity at release, frame of the object [rad/s].
    aim: Vectors  #: Intended point at the catch height [m].
    hover_steps: Counts  #: Control steps before the release.

    def flight_time(self) -> Scalars:
        """Return the time from release to the catch height, without drag [s]."""
        return flight_time(self.lin_vel, self.aim[:, 2] - self.pos[:, 2])


def sample_throws(
    cfg: ThrowCfg, num_envs: int, generator: torch.Generator, drag: Scalars | None = None
) -> Throw:
    """Draw throws on the generator's device.

    They reach their aim in spite of `drag`: deceleration by air over the square of the speed [1/m].
    """
    if cfg.peak_z[1] < (least := cfg.clearance + max(cfg.release_z[0], cfg.aim_z[0])):
        raise InvalidValueError(
            f"peak_z is up to {cfg.peak_z[1]:g} m; release_z, aim_z, clearance need {least:g} m: change one."
        )
    device = generator.device
    ranges = (cfg.release_x, cfg.release_y, cfg.release_z, cfg.aim_x, cfg.aim_y, cfg.aim_z, cfg.peak_z)
    draws = uniform(ranges, num_envs, generator)
    pos, aim, peak = draws[:, 0:3], draws[:, 3:6], draws[:, 6]
    quat = torch.nn.functional.normalize(torch.randn(num_envs, 4, generator=generator, device=device), dim=-1)
    first, last = cfg.hover_steps
    hover_steps = torch.randint(first, last + 1, (num_envs,), generator=generator, device=device)
    peak = torch.maximum(peak, cfg.clearance + torch.maximum(pos[:, 2], aim[:, 2]))
    if cfg.least_elevation:
        peak = torch.maximum(peak, peak_of_elevation(pos, aim, cfg.least_elevation))
    lin_vel = launch_velocity(pos, aim, peak)
    if drag is not None:
        lin_vel = velocity_through_air(pos, aim, lin_vel, drag)
    lin_vel, ang_vel = _released(cfg, lin_vel, generator), torch.zeros_like(pos)
    if cfg.spin:
        speed = cfg.spin * torch.rand(num_envs, 1, generator=generator, device=device)
        ang_vel = speed * random_directions(num_envs, generator)
    return Throw(pos=pos, quat=quat, lin_vel=lin_vel, ang_vel=ang_vel, aim=aim, hover_steps=hover_steps)


def _released(cfg: ThrowCfg, lin_vel: Vectors, generator: torch.Generator) -> Vectors:
    """Return the intended velocity with the thrower's errors of speed, elevation and azimuth [m/s]."""
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


def launch_velocity(pos: Vectors, aim: Vectors, peak: Scalars) -> Vectors:
    """Return the velocity at `pos` of the path with this peak height that falls through `aim` [m/s]."""
    rise = torch.sqrt(2.0 * (peak - pos[:, 2]) / GRAVITY)
    fall = torch.sqrt(2.0 * (peak - aim[:, 2]) / GRAVITY)
    horizontal = (aim[:, :2] - pos[:, :2]) / (rise + fall)[:, None]
    return torch.cat((horizontal, (GRAVITY * rise)[:, None]), dim=-1)


LEAST_FALL = 0.05  #: Least height at the aim of the straight line of an elevation [m]. Source: ours.


def peak_of_elevation(pos: Vectors, aim: Vectors, elevation: float) -> Scalars:
    """Return the peak height [m] of the path from `pos` to `aim` that begins at an elevation [rad]."""
    rise = torch.linalg.vector_norm(aim[:, :2] - pos[:, :2], dim=-1) * tan(elevation)
    fall = (rise + pos[:, 2] - aim[:, 2]).clamp(min=LEAST_FALL)
    return pos[:, 2] + rise.square() / (4.0 * fall)


def drawn(amount: Amount, num_envs: int, generator: torch.Generator) -> Scalars:
    """Draw the amount of every episode, on the generator's device; a number is returned as it is."""
    if isinstance(amount, tuple):
        return uniform((amount,), num_envs, generator)[:, 0]
    return torch.full((num_envs,), float(amount), device=generator.device)


def random_directions(num_envs: int, generator: torch.Generator) -> Vectors:
    """Return unit vectors, uniform over all directions, on the generator's device."""
    normal = torch.randn(num_envs, 3, generator=generator, device=generator.device)
    return torch.nn.functional.normalize(normal, dim=-1)


NUM_STEPS = 16  #: Steps of the midpoint rule in a flight. Source: ours, accurate to 1 mm.
NUM_CORRECTIONS = 4  #: Corrections of the aim; each leaves less than a third of the error. Source: ours.


def flight_time(lin_vel: Vectors, height: Scalars) -> Scalars:
    """Return the time until an object without drag falls through this height above its release [s]."""
    up = lin_vel[:, 2]
    return (up + torch.sqrt(torch.clamp(up.square() - 2.0 * GRAVITY * height, min=0.0))) / GRAVITY


def velocity_through_air(pos: Vectors, aim: Vectors, lin_vel: Vectors, drag: Scalars) -> Vectors:
    """Return the velocity at release that reaches the aim through air, in the time without air [m/s].

    `lin_vel` is the velocity without air [m/s], `drag` the deceleration over the square of the speed [1/m].
    """
    duration = flight_time(lin_vel, aim[:, 2] - pos[:, 2])[:, None]
    for _ in range(NUM_CORRECTIONS):
        missed = aim - flight_path(pos, lin_vel, drag, duration[:, 0])[-1]
        lin_vel = lin_vel + missed / duration
    return lin_vel


def flight_path(
    pos: Vectors,
    lin_vel: Vectors,
    drag: Scalars,
    duration: Scalars,
    side_force: Vectors | None = None,
    num_steps: int = NUM_STEPS,
) -> Float[Tensor, "num_points num_envs 3"]:
    """Return points of a flight through air, at equal time steps from the release to `duration` [m].

    A flight begins at `pos` [m] with `lin_vel` [m/s]. Drag and side force are accelerations over the square
    of the speed [1/m].
    """
    step, path = duration[:, None] / num_steps, [pos]
    for _ in range(num_steps):
        middle = lin_vel + 0.5 * step * _acceleration(lin_vel, drag[:, None], side_force)
        path.append(path[-1] + step * middle)
        lin_vel = lin_vel + step * _acceleration(middle, drag[:, None], side_force)
    return torch.stack(path)


def sample_paths(cfg: ThrowCfg, num_throws: int, seed: int = 0) -> Float[Tensor, "num_throws num_points 3"]:
    """Return points on drawn flights without air, from the release to the aim [m]."""
    throw = sample_throws(cfg, num_throws, torch.Generator().manual_seed(seed))
    path = flight_path(throw.pos, throw.lin_vel, torch.zeros(num_throws), throw.flight_time())
    return path.transpose(0, 1).double()


def _acceleration(lin_vel: Tensor, drag: Tensor, side_force: Tensor | None) -> Tensor:
    speed = torch.linalg.vector_norm(lin_vel, dim=-1, keepdim=True)
    acceleration = -drag * speed * lin_vel
    acceleration[:, 2] -= GRAVITY
    return acceleration if side_force is None else acceleration + side_force * speed.square()
