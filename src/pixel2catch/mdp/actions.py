"""From actions in [-1, 1] to joint position targets, by one affine map for arm and hand.

Arm: the scaled action is added to the measured joint position. Hand: the action, rescaled to the joint
limits, is the target. Source: paper, Sec. IV-D.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.robots.spec import JointSpec
from pixel2catch.scene.constants import CONTROL_DT


@dataclass(frozen=True, kw_only=True)
class JointCommand:
    """How an action becomes a target: `anchor * position + offset + scale * action`, within the limits."""

    anchor: float  #: 1 if the action is relative to the measured position, 0 if it is absolute.
    offset: float  #: Target at action 0 of an absolute joint [rad].
    scale: float  #: Target change by action 1 [rad].
    lower: float  #: Lowest target [rad].
    upper: float  #: Highest target [rad].


def relative_command(joint: JointSpec) -> JointCommand:
    """Return targets relative to the measured position; action 1 is the speed limit in steady motion.

    A heavily damped servo with stiffness k and damping d moves at k / d times the distance of its command.
    The command ramps over the control step T, so at a steady speed v the target is v (d / k + T) ahead.

    Source: paper (added to the current joint positions); the scale is ours: the paper gives none.
    Differs: the release adds up to 0.05 rad to the previous target in each of four physics steps.
    """
    scale = joint.velocity_limit * (joint.damping / joint.stiffness + CONTROL_DT)
    return JointCommand(anchor=1.0, offset=0.0, scale=scale, lower=joint.lower, upper=joint.upper)


def absolute_command(joint: JointSpec) -> JointCommand:
    """Return targets over the whole range of the joint. Source: paper, Sec. IV-D."""
    middle, half_range = (joint.upper + joint.lower) / 2, (joint.upper - joint.lower) / 2
    return JointCommand(anchor=0.0, offset=middle, scale=half_range, lower=joint.lower, upper=joint.upper)


@dataclass(frozen=True)
class ActionMap:
    """The commands of all joints as rows of a tensor."""

    table: Float[Tensor, "5 num_joints"]  #: anchor, offset, scale, lower and upper, one row each.

    @classmethod
    def of(cls, commands: tuple[JointCommand, ...], device: torch.device) -> "ActionMap":
        """Stack the commands of joints in joint order."""
        rows = [(c.anchor, c.offset, c.scale, c.lower, c.upper) for c in commands]
        return cls(torch.tensor(rows, dtype=torch.float32, device=device).T.contiguous())

    def joint_pos_target(
        self, action: Float[Tensor, "num_envs num_joints"], joint_pos: Float[Tensor, "num_envs num_joints"]
    ) -> Float[Tensor, "num_envs num_joints"]:
        """Return joint targets [rad] of actions, which are clipped to [-1, 1]."""
        anchor, offset, scale, lower, upper = self.table
        target = anchor * joint_pos + offset + scale * action.clamp(-1.0, 1.0)
        return torch.clamp(target, lower, upper)
