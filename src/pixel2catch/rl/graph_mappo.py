"""skrl's MAPPO with the same update, made of gradient steps that run as CUDA graphs."""

from typing import Any

import torch
from skrl.multi_agents.torch.mappo import MAPPO
from skrl.multi_agents.torch.mappo.mappo import compute_gae

from pixel2catch.rl.config import TrainCfg
from pixel2catch.rl.gradient_step import Batch, GradientStep
from pixel2catch.rl.scaling import standardised
from pixel2catch.rl.workers import Workers

HIGHEST_LEARNING_RATE = 1e-2
"""Upper bound of the adaptive learning rate. Source: skrl (`KLAdaptiveLR`)."""

ADVICE = "advice"
"""Name of the memories' tensor of a teacher's actions."""


class GraphMAPPO(MAPPO):
    """MAPPO whose `update` waits for the device once; a test compares it with skrl's own."""

    def __init__(self, train_cfg: TrainCfg, workers: Workers, **arguments: Any) -> None:
        """Build skrl's MAPPO and replace its optimisers."""
        super().__init__(**arguments)
        self._train_cfg, self._workers = train_cfg, workers
        self.steps: dict[str, GradientStep] = {}
        for agent, models in self.models.items():
            self.steps[agent] = GradientStep(train_cfg, models["policy"], models["value"], workers)  # pyright: ignore[reportArgumentType] (built in mappo.py)
            self.optimizers[agent] = self.checkpoint_modules[agent]["optimizer"] = self.steps[agent].optimizer

    def expect_advice(self) -> None:
        """Make room for a teacher's actions, which every transition must then have."""
        for agent, memory in (self.memories or {}).items():
            size = self.models[agent]["policy"].num_actions
            memory.create_tensor(name=ADVICE, size=size, dtype=torch.float32)
        self._tensors_names.append(ADVICE)

    def update(self, *, timestep: int, timesteps: int, uid: str) -> None:
        """Learn from the memory of one agent and track losses, KL divergence and standard deviation."""
        cfg, step, memory = self._train_cfg, self.steps[uid], self.memories[uid]  # pyright: ignore[reportOptionalSubscript]
        self._estimate_advantages(uid)
        epochs = []
        for epoch in range(cfg.epochs):
            is_first = epoch == 0
            step.totals.zero_()
            for observations, states, *others in memory.sample(
                self._tensors_names, batch_size=len(memory), mini_batches=cfg.mini_batches
            ):
                scaled_observations = self._observation_preprocessor[uid](observations, train=is_first)
                scaled_states = self._state_preprocessor[uid](states, train=is_first)
                step.take(Batch(scaled_observations, scaled_states, *others))
            epochs.append(step.totals / cfg.mini_batches)
            if cfg.schedule == "kl":
                step.learning_rate.fill_(adapted_rate(cfg, step.learning_rate.item(), epochs[-1][2].item()))
        std = step.action_std
        results = torch.cat((torch.stack(epochs).mean(0), std[None], step.learning_rate[None]))
        for name, value in zip(METRICS, results.tolist(), strict=True):
            self.track_data(f"{name}/{uid}", value)

    @torch.no_grad()
    def _estimate_advantages(self, uid: str) -> None:
        """Fill in returns and advantages, and standardise them and the values. Source: skrl (`MAPPO.update`).

        skrl standardises advantages by the statistics of one process; these are of all.
        """
        cfg, memory = self._train_cfg, self.memories[uid]  # pyright: ignore[reportOptionalSubscript]
        scaler = self._value_preprocessor[uid]
        states = self._state_preprocessor[uid](self._current_next_states[uid])
        last_values, _ = self.models[uid]["value"].act({"states": states}, role="value")
        values = memory.get_tensor_by_name("values")
        returns, _ = compute_gae(
            rewards=memory.get_tensor_by_name("rewards"),
            terminated=memory.get_tensor_by_name("terminated"),
            truncated=memory.get_tensor_by_name("truncated"),
            values=values,
            last_values=scaler(last_values, inverse=True),
            discount_factor=cfg.discount,
            lambda_coefficient=cfg.gae_lambda,
        )
        advantages = standardised(self._workers, returns - values)
        memory.set_tensor_by_name("values", scaler(values, train=True))
        memory.set_tensor_by_name("returns", scaler(returns, train=True))
        memory.set_tensor_by_name("advantages", advantages)


METRICS = ("policy_loss", "value_loss", "kl", "action_std", "learning_rate")
"""What `update` tracks, by agent."""


def adapted_rate(cfg: TrainCfg, rate: float, kl: float) -> float:
    """Return the learning rate after an epoch with this KL divergence.

    Source: release (skrl's `KLAdaptiveLR`: factor 1.5 where the divergence is twice or half of the target).
    """
    if kl > 2.0 * cfg.kl_target:
        return max(rate / 1.5, cfg.final_learning_rate)
    if kl < 0.5 * cfg.kl_target:
        return min(rate * 1.5, HIGHEST_LEARNING_RATE)
    return rate
