"""Throws through air: a thrower makes up for the drag, so that what is thrown still arrives."""

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.scene.constants import GRAVITY

NUM_STEPS = 16
"""Steps of the midpoint rule in a flight. Source: ours, a millimetre."""

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
        missed = aim - _arrival(pos, lin_vel, drag[:, None], duration)
        lin_vel = lin_vel + missed / duration
    return lin_vel


def _arrival(pos: Tensor, lin_vel: Tensor, drag: Tensor, duration: Tensor) -> Tensor:
    """Where an object is after a flight through air [m]."""
    step = duration / NUM_STEPS
    for _ in range(NUM_STEPS):
        middle = lin_vel + 0.5 * step * _acceleration(lin_vel, drag)
        pos = pos + step * middle
        lin_vel = lin_vel + step * _acceleration(middle, drag)
    return pos


def _acceleration(lin_vel: Tensor, drag: Tensor) -> Tensor:
    """Drag and gravity [m/s²]."""
    acceleration = -drag * torch.linalg.vector_norm(lin_vel, dim=-1, keepdim=True) * lin_vel
    acceleration[:, 2] -= GRAVITY
    return acceleration
