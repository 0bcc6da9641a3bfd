"""Forward kinematics of a chain of joints, read from a compiled model and batched in torch.

The matrix of joint i is K + cos(q) C + sin(q) S. A pose is the product of these homogeneous matrices. No call
copies between host and device or branches on a value, so a chain works inside CUDA graphs.
"""

from collections.abc import Sequence
from itertools import accumulate

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.poses import pose_matrix


class Chain:
    """The hinges between the world and a site, from base to tip."""

    def __init__(
        self,
        model: mujoco.MjModel,
        site: str,
        home: Sequence[float],
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Read the chain from a model; `home` are the start positions of its joints [rad].

        Raises:
            InvalidValueError: A joint that moves the site is no hinge, or `home` has the wrong length.
        """
        self.joints, matrices = _read(model, site)
        if len(self.joints) != len(home):
            raise InvalidValueError(
                f"{len(home)} start positions were given; give one for each joint that moves the site "
                f"'{site}': {', '.join(self.joints)}."
            )
        #: K, C and S of each joint, multiplied by the fixed transforms between joints.
        self.matrices = torch.as_tensor(matrices, dtype=dtype, device=device)
        self._products = torch.as_tensor(_product_maps(), dtype=dtype, device=device)
        self.side = torch.ones(4, dtype=dtype, device=device)
        _, start = self.pose(torch.tensor([home], dtype=dtype, device=device))
        #: Sign convention: of q and -q, return the one with a positive product with this quaternion, the
        #: orientation at the start pose with its largest entry negative. Differs: paper and release return
        #: w >= 0; w is 0 at the start pose, where noise would flip all four entries.
        self.side = -start[0] * start[0, start[0].abs().argmax()].sign()

    def link_poses(
        self, joint_pos: Float[Tensor, "num_envs num_joints"]
    ) -> Float[Tensor, "num_envs num_joints 4 4"]:
        """Return the world frame at the far end of each link; the last one is the site's."""
        return torch.stack([*accumulate(self._transforms(joint_pos).unbind(dim=1), _multiply)], dim=1)

    def pose(
        self, joint_pos: Float[Tensor, "num_envs num_joints"]
    ) -> tuple[Float[Tensor, "num_envs 3"], Float[Tensor, "num_envs 4"]]:
        """Return position [m] and orientation (w, x, y, z) of the site in the world, for joints [rad]."""
        transforms = [*self._transforms(joint_pos).unbind(dim=1)]
        while len(transforms) > 3:  # multiply in pairs: fewer dependent kernels
            whole, rest = len(transforms) // 2 * 2, transforms[len(transforms) // 2 * 2 :]
            left, right = torch.stack(transforms[0:whole:2], 1), torch.stack(transforms[1:whole:2], 1)
            transforms = [*_multiply(left, right).unbind(dim=1), *rest]
        *_, pose = accumulate(transforms, _multiply)
        return pose[:, :3, 3], self._quaternion(pose)

    def _transforms(
        self, joint_pos: Float[Tensor, "num_envs num_joints"]
    ) -> Float[Tensor, "num_envs num_joints 4 4"]:
        constant, cosine, sine = self.matrices.unbind(0)
        angle = joint_pos[..., None, None]
        return constant + torch.cos(angle) * cosine + torch.sin(angle) * sine

    def _quaternion(self, pose: Float[Tensor, "num_envs 4 4"]) -> Float[Tensor, "num_envs 4"]:
        """Convert the rotation by the row of 4 q qᵀ with the largest diagonal entry."""
        products = (self._products * pose.reshape(-1, 1, 1, 16)).sum(-1)
        diagonal = products.diagonal(dim1=-2, dim2=-1)
        largest = diagonal.argmax(-1, keepdim=True)
        row = products.gather(1, largest[..., None].expand(-1, 1, 4)).squeeze(1)
        quat = row / (2.0 * diagonal.gather(1, largest).sqrt())
        side = (quat * self.side).sum(dim=-1, keepdim=True)
        return torch.where(side < 0, -quat, quat)


def _read(model: mujoco.MjModel, site: str) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names of the joints that move a site, and K, C, S: (3, num_joints, 4, 4)."""
    end = model.site(site)
    body, after = int(end.bodyid[0]), pose_matrix(end.pos, end.quat)
    names, afters, axes = list[str](), list[np.ndarray](), list[np.ndarray]()
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        if count > 1 or (count and model.jnt_type[first] != mujoco.mjtJoint.mjJNT_HINGE):
            raise InvalidValueError(
                f"body '{model.body(body).name}' has another joint than one hinge; use one hinge a body."
            )
        if count:
            place = pose_matrix(model.jnt_pos[first], (1.0, 0.0, 0.0, 0.0))
            names.append(model.joint(first).name)
            afters.append(np.linalg.inv(place) @ after)
            axes.append(model.jnt_axis[first])
            after = place
        after = pose_matrix(model.body_pos[body], model.body_quat[body]) @ after
        body = int(model.body_parentid[body])
    leading = [np.eye(4)] * (len(names) - 1) + [after]
    parts = [
        [before @ part @ following for part in _turning(axis)]
        for before, axis, following in zip(leading, axes, afters, strict=True)
    ]
    return tuple(reversed(names)), np.stack(parts[::-1], axis=1)


def _turning(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return K, C, S of Rodrigues' formula: the rotation about an axis is K + cos C + sin S."""
    constant, cosine, sine = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    x, y, z = axis
    constant[:3, :3], constant[3, 3] = np.outer(axis, axis), 1.0
    cosine[:3, :3] = np.eye(3) - np.outer(axis, axis)
    sine[:3, :3] = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    return constant, cosine, sine


def _product_maps() -> np.ndarray:
    """Return the products 4 q_i q_j as linear maps of the entries of a homogeneous matrix: (4, 4, 16)."""
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


def _multiply(left: Tensor, right: Tensor) -> Tensor:
    """Multiply matrices (..., 4, 4) elementwise, as matrix units would reduce the precision."""
    return (left.unsqueeze(-1) * right.unsqueeze(-3)).sum(-2)
