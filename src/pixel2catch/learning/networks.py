"""Policy and value function of an agent, and the standardisation of their inputs."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.distributed import Workers
from pixel2catch.policy import build_mlp
from pixel2catch.policy.policy import INPUT_CLIP

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
        self.policy = build_mlp(num_observations, num_actions, cfg.hidden)
        self.log_std = nn.Parameter(torch.full((num_actions,), cfg.initial_log_std))
        self.value = build_mlp(num_states, 1, cfg.hidden)
        self.observation_scale = Standardizer(num_observations)
        self.state_scale = Standardizer(num_states)
        self.value_scale = Standardizer()
        self.to(cfg.device)

    @property
    def parts(self) -> dict[str, list[nn.Parameter]]:
        """Parameters of the policy and of the value network."""
        return {"policy": [self.log_std, *self.policy.parameters()], "value": [*self.value.parameters()]}

    def value_of(self, states: Tensor) -> Tensor:
        """Return the values of states, (num_envs,)."""
        return self.value_scale.inverse(self.value(self.state_scale(states))[..., 0])

    def act(self, observations: Tensor, states: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw actions; return them, their log probability, and the values."""
        mean = self.policy(self.observation_scale(observations))
        actions = mean + self.log_std.exp() * torch.randn_like(mean)
        return actions, self.log_prob(mean, actions), self.value_of(states)

    def log_prob(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Return the logarithm of the probability density of actions about a mean."""
        error = (actions - mean) * (-self.log_std).exp()
        return -(0.5 * error.square() + self.log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1)

    def entropy(self) -> Tensor:
        """Return the entropy of an action."""
        return (self.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
