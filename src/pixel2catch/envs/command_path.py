"""What lies between a command and a joint's servo: latency and the command filter of `JointDynamics`."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.mdp.masks import select
from pixel2catch.robots.joint_dynamics import JointDynamics, command_lag, filter_transition


class CommandPath:
    """The paths of all joints in all environments, on memory that stays where it is.

    Commands are known at the ends of physics steps and are linear in between, as a ramp is. What arrives in a
    step is their mean over a step of the past, as in the simulation of recordings: exact at any latency.
    """

    def __init__(
        self, dynamics: JointDynamics, dt: float, command: Float[Tensor, "num_envs num_joints"]
    ) -> None:
        """Make the paths; `reset` begins.

        Args:
            dynamics: The joints.
            dt: Physics time step [s].
            command: Commands, of which number, type and device are taken.
        """
        share = _shares(0.5 + command_lag(dynamics, dt) / dt)
        self._share = torch.as_tensor(share).to(command)[:, None]
        self._history = command.expand(len(share), -1, -1).clone()
        self._transition = torch.as_tensor(filter_transition(dynamics, dt)).to(command)
        self._state = torch.stack((command, torch.zeros_like(command)), dim=-1)

    def reset(self, mask: Bool[Tensor, " num_envs"], joint_pos: Float[Tensor, "num_envs num_joints"]) -> None:
        """Let the masked environments have had their joints' positions for a command up to now [rad]."""
        self._history.copy_(torch.where(mask[:, None], joint_pos, self._history))
        at_rest = torch.stack((joint_pos, torch.zeros_like(joint_pos)), dim=-1)
        self._state.copy_(select(mask, at_rest, self._state))

    def advance(self, command: Float[Tensor, "num_envs num_joints"]) -> Float[Tensor, "num_envs num_joints"]:
        """What the servos aim at in a physics step [rad]; the next step overwrites it.

        Args:
            command: The commands at the end of the step [rad].
        """
        self._history.copy_(torch.cat((command[None], self._history[:-1])))
        delayed = (self._share * self._history).sum(dim=0)
        self._state.copy_(filtered(self._transition, self._state, delayed))
        return self._state[..., 0]


def _shares(age: Float[np.ndarray, " num_joints"]) -> Float[np.ndarray, "num_ages num_joints"]:
    """Share of each known command, newest first, in the mean over the step whose middle has an age.

    That is the integral of their linear interpolation: a quadratic B-spline.

    Args:
        age: Physics steps between that middle and the newest command, at least 0.5.
    """
    distance = np.abs(np.arange(int(np.ceil(age.max() + 0.5)) + 1)[:, None] - age)
    return np.where(distance < 0.5, 0.75 - distance**2, np.maximum(1.5 - distance, 0.0) ** 2 / 2)


def filtered(
    transition: Float[Tensor, "*copies num_joints 2 2"],
    state: Float[Tensor, "num_copies num_joints 2"],
    command: Float[Tensor, "num_copies num_joints"],
) -> Float[Tensor, "num_copies num_joints 2"]:
    """Position [rad] and speed [rad/s] of the joints' command filters after a step.

    Args:
        transition: Of every joint, or of every joint of every copy; see `filter_transition`.
        state: Position and speed before the step.
        command: What the filters follow in the step [rad].
    """
    goal = torch.nn.functional.pad(command[..., None], (0, 1))  # at rest on the command
    error = state - goal
    return goal + transition[..., 0] * error[..., :1] + transition[..., 1] * error[..., 1:]
