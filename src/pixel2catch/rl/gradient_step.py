"""One gradient step of PPO on a mini-batch, replayed as a CUDA graph where there is CUDA.

The step is some two hundred small kernels. Launched one by one they keep the GPU waiting for the host most of
the time (8,192 environments x 16 steps on one H100: 180 ms an update, of which the GPU works 65;
as graphs 74 ms).
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from pixel2catch.rl.config import TrainCfg
from pixel2catch.rl.models import GaussianPolicy, ValueFunction
from pixel2catch.rl.workers import Workers

NUM_EAGER_STEPS = 3
"""Steps before the graph is captured: libraries set themselves up in the first. Source: torch's manual."""


class Batch(NamedTuple):
    """A mini-batch; observations, states, values and returns are standardised.

    Its advice are the actions of a teacher, where there is one.
    """

    observations: Tensor
    states: Tensor
    actions: Tensor
    log_prob: Tensor
    values: Tensor
    returns: Tensor
    advantages: Tensor
    advice: Tensor | None = None


class GradientStep:
    """Takes gradient steps for one agent.

    Attributes:
        optimizer: Adam, with its learning rate in a tensor, so that a captured step sees it change.
        totals: Sums of policy loss, value loss and KL divergence over the steps since they were put to zero;
            of all processes together, like the gradients.
        teacher_weight: How far the policy follows a teacher instead of its rewards, to be changed in place.
    """

    def __init__(self, cfg: TrainCfg, policy: GaussianPolicy, value: ValueFunction, workers: Workers) -> None:
        """Prepare for the parameters of one agent's models."""
        self._cfg, self._policy, self._value, self._workers = cfg, policy, value, workers
        self._parameters = [*policy.parameters(), *value.parameters()]
        self._is_cuda = cfg.device.startswith("cuda")
        rate = torch.tensor(cfg.learning_rate, device=cfg.device)
        self.optimizer = torch.optim.Adam(self._parameters, lr=rate, fused=True, capturable=self._is_cuda)
        self.totals = torch.zeros(3, device=cfg.device)
        self._policy_weight = torch.ones((), device=cfg.device)
        self.teacher_weight = torch.zeros((), device=cfg.device)
        self._batch: Batch | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._num_steps = 0

    @property
    def learning_rate(self) -> Tensor:
        """Learning rate, to be changed in place."""
        return self.optimizer.param_groups[0]["lr"]

    @property
    def action_std(self) -> Tensor:
        """Standard deviation of the actions, averaged over them."""
        return self._policy.log_std.detach().exp().mean()

    def take(self, batch: Batch) -> None:
        """Take one step; nothing waits for the device."""
        if self._batch is None:
            self._batch = Batch(*(tensor.clone() for tensor in batch if tensor is not None))
        else:
            for static, tensor in zip(self._batch, batch, strict=True):
                if static is not None and tensor is not None:
                    static.copy_(tensor)
        if self._is_cuda and self._graph is None and self._num_steps >= NUM_EAGER_STEPS:
            self._graph = self._capture(self._batch)
        if self._graph is not None:
            self._graph.replay()
        elif self._is_cuda:
            self._step_aside(self._batch)
        else:
            self._step(self._batch)
        self._num_steps += 1

    def rest_policy(self) -> None:
        """Let the value network alone learn, until `wake_policy`."""
        self._policy_weight.fill_(0.0)

    def wake_policy(self) -> None:
        """Let the policy learn, too, with an optimiser that has seen none of its gradients.

        Adam's averages of gradients that were 0 would make its first step three times as long as any other.
        """
        self._policy_weight.fill_(1.0)
        for parameter in self._policy.parameters():
            for value in self.optimizer.state.get(parameter, {}).values():
                value.zero_()

    def on_restored(self) -> None:
        """Forget what depends on the optimiser's former state, or on the device that the new is from."""
        self.close()
        for group in self.optimizer.param_groups:
            group["capturable"] = self._is_cuda

    def close(self) -> None:
        """Release the graph: a process group does not end while a graph holds a collective of it."""
        self._graph, self._num_steps = None, 0

    def _step(self, batch: Batch) -> None:
        """Source: PPO with clipped ratio and clipped values, as in skrl (`MAPPO.update`).

        A teacher's advice is followed by its weight, and the surrogate objective by the rest.
        """
        cfg = self._cfg
        mean = self._policy.network(batch.observations)
        log_prob = self._policy.log_prob(mean, batch.actions)
        log_ratio = log_prob - batch.log_prob
        ratio = log_ratio.exp()
        clipped_ratio = ratio.clip(1.0 - cfg.ratio_clip, 1.0 + cfg.ratio_clip)
        policy_loss = -torch.min(batch.advantages * ratio, batch.advantages * clipped_ratio).mean()
        change = self._value.network(batch.states) - batch.values
        values = batch.values + change.clip(-cfg.value_clip, cfg.value_clip)
        value_loss = cfg.value_loss_scale * nn.functional.mse_loss(batch.returns, values)
        entropy_loss = -cfg.entropy_scale * self._policy.entropy()
        objective = policy_loss + entropy_loss
        if batch.advice is not None:
            imitation = 0.5 * (mean - batch.advice).square().sum(dim=-1).mean()
            objective = torch.lerp(objective, imitation, self.teacher_weight)
        self.optimizer.zero_grad()
        (self._policy_weight * objective + value_loss).backward()
        with torch.no_grad():
            kl = (ratio - 1.0 - log_ratio).mean()
            losses = torch.stack((policy_loss, value_loss, kl))
        self._workers.average([*self._gradients(), losses])
        nn.utils.clip_grad_norm_(self._parameters, cfg.gradient_clip)
        self.optimizer.step()
        self.totals += losses

    def _gradients(self) -> list[Tensor]:
        return [parameter.grad for parameter in self._parameters if parameter.grad is not None]

    def _step_aside(self, batch: Batch) -> None:
        """Step on another stream, as capturing requires of the steps before it."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self._step(batch)
        torch.cuda.current_stream().wait_stream(stream)

    def _capture(self, batch: Batch) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        self.optimizer.zero_grad()
        # A thread of NCCL may ask for the state of its events meanwhile, which "global" forbids to all.
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self._step(batch)
        return graph
