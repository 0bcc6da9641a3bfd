"""Inverse kinematics by damped least squares, for many targets at once."""

from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.robots.geometry import Chain, bare_model, read_chain
from pixel2catch.robots.workcell import WorkcellSpec


def chain_to(workcell: WorkcellSpec, site: str) -> tuple[Chain, list[int]]:
    """Return the chain of joints between the world and a site, in float64, and their columns."""
    columns = [workcell.joint_names.index(name) for name in read_chain(bare_model(workcell), site)[0]]
    home = [workcell.joints[column].home for column in columns]
    return Chain(bare_model(workcell), site, home, dtype=torch.float64), columns


def pose_and_slopes(
    matrices: Float[Tensor, "3 num_joints 4 4"], joint_pos: Float[Tensor, "num_envs num_joints"]
) -> tuple[Float[Tensor, "num_envs 4 4"], Float[Tensor, "num_envs num_joints 4 4"]]:
    """Return the pose of a site in the world and its derivative by each joint; matrices as in `Chain`."""
    constant, cosine, sine = matrices
    cos, sin = joint_pos.cos()[..., None, None], joint_pos.sin()[..., None, None]
    links = (constant + cos * cosine + sin * sine).unbind(1)
    turns = (cos * sine - sin * cosine).unbind(1)
    unit = torch.eye(4, dtype=joint_pos.dtype, device=joint_pos.device).expand(len(joint_pos), 4, 4)
    before = [unit, *accumulate(links, torch.matmul)]
    after = [unit, *accumulate(reversed(links), lambda right, left: left @ right)][-2::-1]
    slopes = [a @ turn @ b for a, turn, b in zip(before[:-1], turns, after, strict=True)]
    return before[-1], torch.stack(slopes, dim=1)


def joints_reaching(
    matrices: Float[Tensor, "3 num_joints 4 4"],
    joint_pos: Float[Tensor, "num_envs num_joints"],
    limits: Float[Tensor, "2 num_joints"],
    point: Float[Tensor, "num_envs 3"],
    axis: Float[Tensor, "num_envs 3"] | None = None,
    local_axis: Float[Tensor, " 3"] | None = None,
    *,
    axis_weight: float = 0.15,
    damping: float = 1e-3,
    num_steps: int = 8,
) -> Float[Tensor, "num_envs num_joints"]:
    """Return joint positions within limits that bring a site to a point, and an axis of it to another.

    A joint whose limits are equal stays. Position has priority over the axis by the weight.

    Args:
        matrices: Those of the `Chain` to the site.
        joint_pos: Where the search starts [rad].
        limits: Lower and upper limits [rad].
        point: Positions of the site [m].
        axis: Directions of `local_axis` in the world. Default: any.
        local_axis: A direction in the frame of the site.
        axis_weight: Weight of a deviation of the axis [m].
        damping: Weight of a step [m²/rad²].
        num_steps: Gauss-Newton steps.
    """
    is_free = (limits[1] > limits[0]).to(joint_pos)[:, None]
    damp = damping * torch.eye(len(is_free), dtype=joint_pos.dtype, device=joint_pos.device)
    for _ in range(num_steps):
        pose, slopes = pose_and_slopes(matrices, joint_pos)
        error, slope = point - pose[:, :3, 3], slopes[..., :3, 3]
        if axis is not None and local_axis is not None:
            turned = axis_weight * (axis - pose[:, :3, :3] @ local_axis)
            error = torch.cat((error, turned), dim=-1)
            slope = torch.cat((slope, axis_weight * (slopes[..., :3, :3] @ local_axis)), dim=-1)
        joint_pos = (joint_pos + damped_solution(is_free * slope, error, damp)).clamp(*limits)
    return joint_pos


def damped_solution(
    slope: Float[Tensor, "num_envs num_joints k"], error: Float[Tensor, "num_envs k"], damp: Tensor
) -> Float[Tensor, "num_envs num_joints"]:
    """Return the step of the joints that reduces an error, by damped least squares."""
    normal = slope @ slope.transpose(1, 2) + damp
    return torch.linalg.solve(normal, (slope @ error[..., None])[..., 0])
