"""Policy and value function of an agent, and the standardisation of their inputs."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.distributed import Workers
from pixel2catch.policy import build_mlp
from pixel2catch.policy.policy import INPUT_CLIP, gru_step

EPSILON = 1e-8  #: Added to a standard deviation before dividing by it. Source: release (skrl).


class Standardizer(nn.Module):
    """Standardises values by running statistics and clips them."""

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, *size: int) -> None:
        """Start with the statistics of one sample of mean 0 and variance 1."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.ones((), dtype=torch.float64))

    @property
    def std(self) -> Tensor:
        """Standard deviation, by which differences from the mean are divided."""
        return self.variance.float().sqrt() + EPSILON

    @torch.no_grad()
    def learn(self, mean: Tensor, variance: Tensor, num: int) -> None:
        """Update the statistics by `num` values with this mean and unbiased variance.

        Source: parallel variance (Chan et al. 1979).
        """
        total, delta = self.count + num, mean - self.mean
        squares = self.variance * self.count + variance * num + delta**2 * self.count * num / total
        self.mean.copy_(self.mean + delta * num / total)
        self.variance.copy_(squares / total)
        self.count.copy_(total)

    def forward(self, values: Tensor) -> Tensor:
        """Return standardised, clipped values."""
        return ((values - self.mean.float()) / self.std).clamp(-INPUT_CLIP, INPUT_CLIP)

    def inverse(self, values: Tensor) -> Tensor:
        """Return values from standardised ones."""
        return self.variance.float().sqrt() * values.clamp(-INPUT_CLIP, INPUT_CLIP) + self.mean.float()


@torch.no_grad()
def learn_together(workers: Workers, seen: Sequence[tuple[Standardizer, Tensor]]) -> None:
    """Update standardisers by values of all processes, (..., *size), in one exchange."""
    values = [given.reshape(-1, *scale.mean.shape) for scale, given in seen]
    found = workers.moments([(each.mean(dim=0), each.var(dim=0)) for each in values], len(values[0]))
    for (scale, _), (mean, variance) in zip(seen, found, strict=True):
        scale.learn(mean, variance, len(values[0]) * workers.size)


class ActorCritic(nn.Module):
    """Networks of one agent: Gaussian policy of the observation, value function of the state."""

    def __init__(self, cfg: TrainCfg, num_observations: int, num_states: int, num_actions: int) -> None:
        """Build untrained networks; the global torch generator of the CPU decides on their weights."""
        super().__init__()
        size = cfg.recurrent
        self.policy_gru = nn.GRUCell(num_observations, size) if size else None
        self.policy = build_mlp(size or num_observations, num_actions, cfg.hidden)
        self.log_std = nn.Parameter(torch.full((num_actions,), cfg.initial_log_std))
        self.value_gru = nn.GRUCell(num_states, size) if size else None
        self.value = build_mlp(size or num_states, 1, cfg.hidden)
        self.observation_scale = Standardizer(num_observations)
        self.state_scale = Standardizer(num_states)
        self.value_scale = Standardizer()
        self.to(cfg.device)

    @property
    def parts(self) -> dict[str, list[nn.Parameter]]:
        """Parameters of the policy and of the value network."""
        groups = {"policy": (self.policy, self.policy_gru), "value": (self.value, self.value_gru)}
        parts = {
            name: [parameter for module in modules if module for parameter in module.parameters()]
            for name, modules in groups.items()
        }
        return {**parts, "policy": [self.log_std, *parts["policy"]]}

    def value_of(self, states: Tensor, hidden_state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the values of states, (num_envs,), and the new hidden state."""
        features, hidden_state = gru_step(self.value_gru, self.state_scale(states), hidden_state)
        return self.value_scale.inverse(self.value(features)[..., 0]), hidden_state

    def act(
        self, observations: Tensor, states: Tensor, policy_state: Tensor, value_state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Draw actions; return them, their log probability, the values, and both new hidden states."""
        features, policy_state = gru_step(self.policy_gru, self.observation_scale(observations), policy_state)
        mean = self.policy(features)
        actions = mean + self.log_std.exp() * torch.randn_like(mean)
        values, value_state = self.value_of(states, value_state)
        return actions, self.log_prob(mean, actions), values, policy_state, value_state

    def log_prob(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Return the logarithm of the probability density of actions about a mean."""
        error = (actions - mean) * (-self.log_std).exp()
        return -(0.5 * error.square() + self.log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1)

    def entropy(self) -> Tensor:
        """Return the entropy of an action."""
        return (self.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()


def gru_rollout(gru: nn.GRUCell | None, inputs: Tensor, hidden_state: Tensor, is_first: Tensor) -> Tensor:
    """Return the inputs of the hidden layers over whole rollouts, by `gru_step` after `gru_step`.

    Args:
        gru: The unit before the hidden layers, if there is one.
        inputs: Standardised inputs, (num_steps, num_envs, num_inputs).
        hidden_state: State before the first step, (1, num_envs, size).
        is_first: Where an episode begins, and the state is reset, (num_steps, num_envs).
    """
    if gru is None:
        return inputs
    features, now = [], hidden_state[0]
    for step, begins in zip(inputs, is_first, strict=True):
        _, now = gru_step(gru, step, now * ~begins[:, None])
        features.append(now)
    return torch.stack(features)
