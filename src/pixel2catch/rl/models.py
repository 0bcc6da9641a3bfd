"""skrl's views of the networks: a Gaussian policy and a value function."""

import math
from typing import Any

import gymnasium
import torch
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from torch import Tensor, nn

from pixel2catch.policy import build_mlp
from pixel2catch.rl.config import TrainCfg


class GaussianPolicy(GaussianMixin, Model):
    """Actions with a mean that depends on the observation and a standard deviation that does not."""

    def __init__(
        self, cfg: TrainCfg, observation_space: gymnasium.Space, action_space: gymnasium.Space
    ) -> None:
        """Build the mean network."""
        Model.__init__(
            self, observation_space=observation_space, action_space=action_space, device=cfg.device
        )
        GaussianMixin.__init__(self, clip_log_std=False)
        self.network = build_mlp(self.num_observations, self.num_actions, cfg.hidden)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), cfg.initial_log_std))

    def compute(  # pyright: ignore[reportIncompatibleMethodOverride] (the mixin passes it by position)
        self, inputs: dict[str, Any], role: str = ""
    ) -> tuple[Tensor, dict[str, Any]]:
        """Return mean and log standard deviation for standardised observations."""
        return self.network(inputs["observations"]), {"log_std": self.log_std}

    def log_prob(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Return the logarithm of the probability density of actions about a mean, (num_envs, 1)."""
        error = (actions - mean) * (-self.log_std).exp()
        return -(0.5 * error.square() + self.log_std + 0.5 * math.log(2.0 * math.pi)).sum(-1, keepdim=True)

    def entropy(self) -> Tensor:
        """Return the entropy of an action."""
        return (self.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()


class ValueFunction(DeterministicMixin, Model):
    """Value of a state for one agent (standardised)."""

    def __init__(self, cfg: TrainCfg, state_space: gymnasium.Space, action_space: gymnasium.Space) -> None:
        """Build the network."""
        Model.__init__(self, state_space=state_space, action_space=action_space, device=cfg.device)
        DeterministicMixin.__init__(self)
        self.network = build_mlp(self.num_states, 1, cfg.hidden)

    def compute(  # pyright: ignore[reportIncompatibleMethodOverride] (the mixin passes it by position)
        self, inputs: dict[str, Any], role: str = ""
    ) -> tuple[Tensor, dict[str, Any]]:
        """Return the value for standardised states."""
        return self.network(inputs["states"]), {}
