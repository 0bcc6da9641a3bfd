"""The joint servos between command and simulation: speed and effort limits, and dry friction."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.constants import SPEED_MARGIN

EFFORT_MARGIN = 0.999
"""Share of a joint's effort limit that a servo asks for; at the limit itself MuJoCo clamps."""

FRICTION_SPEED = 0.1
"""Speed at which dry friction reaches 76 % of its value [rad/s] (ours; slow enough for an explicit step)."""


@dataclass(frozen=True, kw_only=True)
class ServoState:
    """Joints and present gains of the servos, one row per environment."""

    joint_pos: Float[Tensor, "num_envs num_joints"]  #: Joint positions [rad].
    joint_vel: Float[Tensor, "num_envs num_joints"]  #: Joint speeds [rad/s].
    stiffness: Float[Tensor, "num_envs num_joints"]  #: Gain on the position error [N·m/rad].
    damping: Float[Tensor, "num_envs num_joints"]  #: Gain on the speed [N·m·s/rad].


@dataclass(frozen=True)
class Servos:
    """Limits and friction of all joints, in joint order."""

    effort_limit: Float[Tensor, " num_joints"]  #: Largest torque [N·m].
    velocity_limit: Float[Tensor, " num_joints"]  #: Largest speed [rad/s].
    frictionloss: Float[Tensor, " num_joints"]  #: Dry friction [N·m].

    @classmethod
    def on(
        cls,
        device: torch.device,
        dtype: torch.dtype,
        dynamics: JointDynamics,
        efforts: Sequence[float],
        speeds: Sequence[float],
    ) -> "Servos":
        """Copy the limits of all joints, and their friction, to a device.

        Args:
            device: Where to.
            dtype: As what.
            dynamics: Of all joints.
            efforts: Their largest torques [N·m].
            speeds: Their largest speeds [rad/s].
        """
        values = (efforts, speeds, dynamics.frictionloss)
        return cls(*(torch.tensor(each, dtype=dtype, device=device) for each in values))

    def limited(
        self, command: Float[Tensor, "num_envs num_joints"], state: ServoState
    ) -> Float[Tensor, "num_envs num_joints"]:
        """The position command nearest to `command` that keeps the joint's speed and effort limits.

        A servo whose damping d dominates moves at k / d times the distance of its command, so that distance
        bounds the speed (the release relies on its simulator's speed limit, which MuJoCo does not have). The
        torque is bounded here and not by MuJoCo's `forcerange`: while a force is clamped, MuJoCo treats its
        damping explicitly, which is unstable at these gains and steps.
        """
        lead = SPEED_MARGIN * self.velocity_limit * state.damping / state.stiffness
        command = torch.clamp(command, state.joint_pos - lead, state.joint_pos + lead)
        balance = state.joint_pos + state.damping * state.joint_vel / state.stiffness
        reach = EFFORT_MARGIN * self.effort_limit / state.stiffness
        return torch.clamp(command, balance - reach, balance + reach)

    def friction(
        self, joint_vel: Float[Tensor, "num_envs num_joints"]
    ) -> Float[Tensor, "num_envs num_joints"]:
        """Torque of dry friction [N·m], as a smooth function of the speed.

        Differs: MuJoCo's own `frictionloss` is a constraint, which doubles the time of a physics step here,
        for torques that move a servo's rest position by less than 0.004 rad.
        """
        return -self.frictionloss * torch.tanh(joint_vel / FRICTION_SPEED)
