"""Inverse kinematics by damped least squares, for many targets at once."""

from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.robots.geometry import Chain

AXIS_WEIGHT = 0.15  #: Weight of the deviation of an axis against that of a point [m]. Source: ours.
DAMPING = 1e-3  #: Weight of a step against the error that remains [m²/rad²]. Source: ours.

Batch = Float[Tensor, "num_envs _"]


def pose_and_slopes(
    chain: Chain, joint_pos: Batch
) -> tuple[Float[Tensor, "num_envs 4 4"], Float[Tensor, "num_envs _ 4 4"]]:
    """Return the pose of a chain's site in the world, and its derivative by each joint [rad]."""
    constant, cosine, sine = chain.matrices
    cos, sin = joint_pos.cos()[..., None, None], joint_pos.sin()[..., None, None]
    links, turns = (constant + cos * cosine + sin * sine).unbind(1), (cos * sine - sin * cosine).unbind(1)
    unit = torch.eye(4).to(joint_pos).expand_as(links[0])
    before = [unit, *accumulate(links, torch.matmul)]
    after = [unit, *accumulate(reversed(links), lambda right, left: left @ right)][-2::-1]
    slopes = [a @ turn @ b for a, turn, b in zip(before[:-1], turns, after, strict=True)]
    return before[-1], torch.stack(slopes, dim=1)


def joints_reaching(
    chain: Chain,
    joint_pos: Batch,
    limits: Float[Tensor, "2 _"],
    point: Batch,
    axis: Batch | None = None,
    local_axis: Float[Tensor, " 3"] | None = None,
    num_steps: int = 8,
) -> Batch:
    """Return joints within limits [rad] that bring a site to a point [m], and its `local_axis` to an axis.

    The search starts at `joint_pos`. A joint with equal limits stays.
    """
    is_free = (limits[1] > limits[0])[:, None]
    for _ in range(num_steps):
        pose, slopes = pose_and_slopes(chain, joint_pos)
        error, slope = point - pose[:, :3, 3], slopes[..., :3, 3]
        if axis is not None and local_axis is not None:
            turned = axis - pose[:, :3, :3] @ local_axis
            error = torch.cat((error, AXIS_WEIGHT * turned), dim=-1)
            slope = torch.cat((slope, AXIS_WEIGHT * slopes[..., :3, :3] @ local_axis), dim=-1)
        joint_pos = (joint_pos + damped_step(is_free * slope, error, DAMPING)).clamp(*limits)
    return joint_pos


def damped_step(slope: Float[Tensor, "num_envs _ _"], error: Batch, damping: float) -> Batch:
    """Return the step of k joints that reduces an error, by damped least squares."""
    normal = slope @ slope.transpose(1, 2) + damping * torch.eye(slope.shape[1]).to(slope)
    return torch.linalg.solve(normal, (slope @ error[..., None])[..., 0])
