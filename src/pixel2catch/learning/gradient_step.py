"""Networks of an agent, standardisation of their inputs, and gradient steps of PPO on mini-batches."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.distributed import Workers
from pixel2catch.policy import build_mlp
from pixel2catch.policy.policy import INPUT_CLIP

EPSILON = 1e-8  #: Added to a standard deviation before dividing by it. Source: release (skrl).
HIGHEST_LEARNING_RATE = 1e-2  #: Upper bound of the adaptive learning rate. Source: release (skrl).
NUM_FREE = 1_000_000  #: Number of values up to which statistics change freely. Source: ours.
LARGEST_CHANGE = 10.0  #: Deviations from the mean up to which values count after these. Source: ours.


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

        Outliers are limited to `LARGEST_CHANGE`, or one could change all later inputs of a policy.
        Source: parallel variance (Chan et al. 1979); the limit is ours.
        """
        limit = torch.where(self.count < NUM_FREE, torch.inf, LARGEST_CHANGE * self.variance.sqrt())
        total, delta = self.count + num, (mean - self.mean).clamp(-limit, limit)
        variance = torch.minimum(variance, limit**2)
        squares = self.variance * self.count + variance * num + delta**2 * self.count * num / total
        self.mean.copy_(self.mean + delta * num / total)
        self.variance.copy_(squares / total)
        self.count.copy_(total)

    def forward(self, values: Tensor) -> Tensor:
        """Return standardised, clipped values."""
        return ((values - self.mean.float()) / self.std).clamp(-INPUT_CLIP, INPUT_CLIP)

    def inverse(self, values: Tensor) -> Tensor:
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
        return (self.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()


class Batch(NamedTuple):
    """Transitions of one agent, (num, ...), or (rollout_steps, num_envs, ...)."""

    observations: Tensor
    states: Tensor
    actions: Tensor
    log_prob: Tensor
    values: Tensor
    returns: Tensor
    advantages: Tensor
    teacher_actions: Tensor  #: Actions of a teacher, (..., 0) without one.

    def each(self, function: Callable[[Tensor], Tensor]) -> "Batch":
        """Return a batch with a function applied to every tensor."""
        return Batch(*map(function, self))


class GradientStep:
    """Gradient steps of one agent."""

    def __init__(self, cfg: TrainCfg, networks: ActorCritic, rollout: Batch) -> None:
        """Prepare for one agent's networks; its rollouts always stay in the same memory."""
        self._cfg, self._networks = cfg, networks
        self._rollout = rollout.each(partial(torch.flatten, end_dim=1))
        self._shuffled = self._rollout
        self._losses = torch.compile(self._losses_of, dynamic=False) if cfg.fuse else self._losses_of
        self._is_cuda = cfg.device.startswith("cuda")
        rate = torch.tensor(cfg.learning_rate, device=cfg.device)
        #: Adam; a tensor holds the learning rate, so that a captured step follows its changes.
        self.optimizer = torch.optim.Adam(
            networks.parameters(), lr=rate, fused=True, capturable=self._is_cuda
        )
        #: Sums of policy loss, value loss and KL divergence over the steps, as means over all processes.
        self.totals = torch.zeros(3, device=cfg.device)
        self._losses_now = self.totals.clone()
        #: Weight of imitation, 0 to 1; changed in place.
        self.teacher_weight = torch.zeros((), device=cfg.device)
        self._policy_weight = torch.ones((), device=cfg.device)
        self.is_frozen = False  #: Whether only the value network is updated.

    @property
    def learning_rate(self) -> Tensor:
        return self.optimizer.param_groups[0]["lr"]

    def shuffle(self, order: Tensor) -> None:
        """Put the rollout into the order of a pass, as `shuffled` draws it."""
        self._shuffled = self._rollout.each(partial(torch.index_select, dim=0, index=order))

    def batch(self, number: int) -> Batch:
        size = self._cfg.rollout_transitions // self._cfg.mini_batches
        return self._shuffled.each(lambda tensor: tensor.narrow(0, number * size, size))

    def differentiate(self, number: int) -> None:
        """Compute gradients and losses on a mini-batch, whose values and returns are standardised."""
        objective, self._losses_now = self._losses(self.batch(number))
        objective.backward()

    @property
    def exchanged(self) -> list[Tensor]:
        """Gradients and losses, which all processes average before `apply`."""
        return [*(p.grad for p in self._networks.parameters() if p.grad is not None), self._losses_now]

    def apply(self) -> None:
        """Clip the gradients and take the step; nothing waits for the device."""
        nn.utils.clip_grad_norm_(self._networks.parameters(), self._cfg.gradient_clip)
        self.optimizer.step()
        self.optimizer.zero_grad()  # at the end, so that a recorded step begins without gradients
        self.totals += self._losses_now

    def freeze_policy(self, is_frozen: bool) -> None:
        """Update only the value network, or the policy again, then with an optimiser state of zeros.

        Averages of gradients that were 0 would make Adam's first step three times too long.
        """
        self._policy_weight.fill_(0.0 if is_frozen else 1.0)
        if self.is_frozen and not is_frozen:
            for parameter in self._networks.parts["policy"]:
                for value in self.optimizer.state.get(parameter, {}).values():
                    value.zero_()
        self.is_frozen = is_frozen

    def load_state_dict(self, state: dict[str, object]) -> None:
        """Restore a state of the optimiser, also of another device."""
        self.optimizer.load_state_dict(state)
        for group in self.optimizer.param_groups:
            group["capturable"] = self._is_cuda

    def _losses_of(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the objective to minimise; and policy loss, value loss and KL divergence.

        Source: PPO with clipped ratio and clipped values (Schulman et al. 2017; release). A teacher's actions
        are imitated by its weight, and the surrogate objective by the rest.
        """
        cfg, networks = self._cfg, self._networks
        mean = networks.policy(networks.observation_scale(batch.observations))
        values = networks.value(networks.state_scale(batch.states))[..., 0]
        log_ratio = networks.log_prob(mean, batch.actions) - batch.log_prob
        ratio = log_ratio.exp()
        clipped_ratio = ratio.clip(1.0 - cfg.ratio_clip, 1.0 + cfg.ratio_clip)
        policy_loss = -torch.min(batch.advantages * ratio, batch.advantages * clipped_ratio).mean()
        change = (values - batch.values).clip(-cfg.value_clip, cfg.value_clip)
        value_loss = cfg.value_loss_scale * (batch.returns - (batch.values + change)).square().mean()
        objective = policy_loss
        if cfg.entropy_scale:
            objective = objective - cfg.entropy_scale * networks.entropy()
        if batch.teacher_actions.shape[-1]:
            imitation = 0.5 * (mean - batch.teacher_actions).square().sum(dim=-1).mean()
            objective = torch.lerp(objective, imitation, self.teacher_weight)
        losses = torch.stack((policy_loss, value_loss, (ratio - 1.0 - log_ratio).mean())).detach()
        return self._policy_weight * objective + value_loss, losses


def shuffled(cfg: TrainCfg) -> Tensor:
    """Random order of the transitions of a rollout."""
    return torch.randperm(cfg.rollout_transitions, device=cfg.device)


def adapted_rate(cfg: TrainCfg, rate: float, kl: float) -> float:
    """Return the learning rate after an epoch with this KL divergence.

    Source: release (skrl: factor 1.5 where the divergence is twice or half of the target).
    """
    if kl > 2.0 * cfg.kl_target:
        return max(rate / 1.5, cfg.final_learning_rate)
    if kl < 0.5 * cfg.kl_target:
        return min(rate * 1.5, HIGHEST_LEARNING_RATE)
    return rate
