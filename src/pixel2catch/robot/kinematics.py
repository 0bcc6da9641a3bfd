"""Pose of the palm from the arm's joint positions: a product of six homogeneous matrices, batched in torch.

No call copies between host and device and no value is looked at, so it runs inside CUDA graphs (after one
call outside, which makes the constants).
"""

from functools import cache
from itertools import accumulate

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.robot.constants import (
    HAND_MOUNT_POS,
    HAND_MOUNT_QUAT,
    PALM_POS,
    ROBOT_BASE_POS,
    ROBOT_BASE_QUAT,
    UR5E_DH,
    Quat,
    Vec3,
)

HOME_SIDE: Quat = (0.0, -0.78, 0.0, -0.63)
"""A quaternion near the palm's at the start pose; of q and -q, which are one rotation, the one on its side
is returned.

Differs: paper and release return w >= 0. At the start pose w is 0, so that noise alone would flip all four
numbers.
"""


def _pose_matrix(pos: Vec3, quat: Quat) -> np.ndarray:
    """Homogeneous matrix (4, 4) of a position [m] and an orientation."""
    w, x, y, z = np.asarray(quat) / np.linalg.norm(quat)
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrix[:3, 3] = pos
    return matrix


def joint_matrices() -> np.ndarray:
    """Matrices (3, 6, 4, 4): K, C, S with joint i's transform = K_i + cos(q_i) C_i + sin(q_i) S_i.

    The transform is before_i Rz(q_i) after_i; the base is before the first joint, the mount and the palm
    after the last.
    """
    before = [np.eye(4) for _ in UR5E_DH]
    after = []
    for d, a, alpha in UR5E_DH:
        after.append(_pose_matrix((a, 0.0, d), (np.cos(alpha / 2), np.sin(alpha / 2), 0.0, 0.0)))
    before[0] = _pose_matrix(ROBOT_BASE_POS, ROBOT_BASE_QUAT) @ np.diag((-1.0, -1.0, 1.0, 1.0))
    after[-1] = (
        after[-1]
        @ _pose_matrix(HAND_MOUNT_POS, HAND_MOUNT_QUAT)
        @ _pose_matrix(PALM_POS, (1.0, 0.0, 0.0, 0.0))
    )
    constant, cosine = np.diag((0.0, 0.0, 1.0, 1.0)), np.diag((1.0, 1.0, 0.0, 0.0))
    sine = np.zeros((4, 4))
    sine[0, 1], sine[1, 0] = -1.0, 1.0
    return np.stack(
        [[b @ part @ a for b, a in zip(before, after, strict=True)] for part in (constant, cosine, sine)]
    )


def _product_maps() -> np.ndarray:
    """Tensor (4, 4, 16): the products 4 q_i q_j as linear maps of the entries of the homogeneous matrix."""
    table = np.zeros((4, 4, 4, 4))
    for i in range(3):
        for j in range(3):
            if i == j:
                for k in range(4):
                    table[k, k, i, i] = 1.0 if k in (0, i + 1) else -1.0
            else:
                table[i + 1, j + 1, i, j] += 1.0
                table[i + 1, j + 1, j, i] += 1.0
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0)), start=1):
        table[0, k, i, j] = table[k, 0, i, j] = 1.0
        table[0, k, j, i] = table[k, 0, j, i] = -1.0
    table[range(4), range(4), 3, 3] = 1.0
    return table.reshape(4, 4, 16)


@cache
def _constants(device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The joint matrices and the quaternion table on a device."""
    return (
        torch.as_tensor(joint_matrices(), dtype=dtype, device=device),
        torch.as_tensor(_product_maps(), dtype=dtype, device=device),
    )


def _multiply(left: Tensor, right: Tensor) -> Tensor:
    """Matrix products (..., 4, 4), summed elementwise to stay clear of reduced-precision matrix units."""
    return (left.unsqueeze(-1) * right.unsqueeze(-3)).sum(-2)


def link_poses(joint_pos: Float[Tensor, "num_envs 6"]) -> Float[Tensor, "num_envs 6 4 4"]:
    """World frames at the far ends of the arm's links; the last is at the palm, in the axes of the hand.

    Args:
        joint_pos: Positions of the arm's joints [rad].
    """
    links = _link_transforms(joint_pos).unbind(dim=1)
    return torch.stack([*accumulate(links, _multiply)], dim=1)


def palm_pose(
    joint_pos: Float[Tensor, "num_envs 6"],
) -> tuple[Float[Tensor, "num_envs 3"], Float[Tensor, "num_envs 4"]]:
    """Pose of the palm in the world frame.

    Args:
        joint_pos: Positions of the arm's joints [rad].

    Returns:
        Position [m] of the palm, and orientation of the hand frame, with the sign on the side of `HOME_SIDE`.
    """
    links, (_, table) = _link_transforms(joint_pos), _constants(joint_pos.device, joint_pos.dtype)
    pairs = _multiply(links[:, 0::2], links[:, 1::2])
    pose = _multiply(_multiply(pairs[:, 0], pairs[:, 1]), pairs[:, 2])
    return pose[:, :3, 3], _quaternion(pose, table)


def _link_transforms(joint_pos: Float[Tensor, "num_envs 6"]) -> Float[Tensor, "num_envs 6 4 4"]:
    joints, _ = _constants(joint_pos.device, joint_pos.dtype)
    constant, cosine, sine = joints.unbind(0)
    angle = joint_pos[..., None, None]
    return constant + torch.cos(angle) * cosine + torch.sin(angle) * sine


def _quaternion(
    pose: Float[Tensor, "num_envs 4 4"], table: Float[Tensor, "4 4 16"]
) -> Float[Tensor, "num_envs 4"]:
    """Rotation part as a quaternion, from the row of 4 q qᵀ with the largest diagonal entry."""
    products = (table * pose.reshape(-1, 1, 1, 16)).sum(-1)
    diagonal = products.diagonal(dim1=-2, dim2=-1)
    largest = diagonal.argmax(-1, keepdim=True)
    row = products.gather(1, largest[..., None].expand(-1, 1, 4)).squeeze(1)
    quat = row / (2.0 * diagonal.gather(1, largest).sqrt())
    side = quat[:, 1:2] * HOME_SIDE[1] + quat[:, 3:4] * HOME_SIDE[3]
    return torch.where(side < 0, -quat, quat)
