"""A small task that two unlike agents must learn together: their pushes add up and move a point to its goal.

Same interface as `CatchEnv`. It writes observations into the same buffers in every step, and it gives one
agent inputs in pixels, which little can be learnt from unless they are standardised.
"""

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pixel2catch.envs.catch_env import Observation
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.mappo import Mappo
from pixel2catch.methods import PROPOSED
from pixel2catch.policy import AgentContract, PolicyContract

EPISODE_STEPS = 12

PUSH = {"anchor": 1.0, "offset": 0.0, "scale": 0.15, "lower": -1.0, "upper": 1.0}

CONTRACT = PolicyContract(
    method="reaching",
    pixel_features=("cx",),
    agents={
        "arm": AgentContract(
            observation=(("distance", 1), ("position", 1), ("last_push", 2)), joints=("pan", "idle")
        ),
        "hand": AgentContract(observation=(("pixel", 1), ("constant", 1)), joints=("finger",)),
    },
    commands={"pan": PUSH, "idle": PUSH, "finger": PUSH},
    control_dt=1 / 30,
    camera={"width": 640.0, "pos": (0.0, 0.1, 2.2)},
    workcell="ur5e_allegro",
)

SMALL = TrainCfg(
    device="cpu",
    num_envs=64,
    rollout_steps=16,
    physics_stages=(),
    transitions=4096,
    epochs=4,
    mini_batches=4,
    hidden=(64, 64),
    initial_log_std=0.0,
    learning_rate=1e-3,
    final_learning_rate=1e-4,
)


@dataclass(frozen=True)
class ReachingCfg:
    """Where to put a NaN: in which step, and into which quantity."""

    bad_step: int = -1
    bad_quantity: str = ""


@dataclass(frozen=True)
class ReachingStep:
    observation: Observation
    rewards: dict[str, Tensor]
    terminated: Tensor
    truncated: Tensor


def observed(policy: dict[str, Tensor], state: Tensor) -> Observation:
    return Observation(policy=policy, state=state, teacher={})


class Statistics:
    def __init__(self) -> None:
        self.episodes = self.successes = 0.0
        self.time_penalty = -0.02

    def pop(self, total: Any = torch.clone, largest: Any = torch.clone) -> dict[str, float]:
        counts = total(torch.tensor([self.episodes, self.successes])).tolist()
        popped = {
            "success_rate": counts[1] / counts[0] if counts[0] else float("nan"),
            "episodes": counts[0],
            "reward_term/arm.time": self.time_penalty,
        }
        self.episodes = self.successes = 0.0
        return popped


class _ReachingEnv:
    method = PROPOSED  # only what its value networks see is asked for
    observation_sizes = {"arm": 4, "hand": 2}  # noqa: RUF012
    state_size = 3
    action_sizes = {"arm": 2, "hand": 1}  # noqa: RUF012

    def __init__(
        self, cfg: TrainCfg, physics_hz: float | None = None, task: ReachingCfg | None = None
    ) -> None:
        self.cfg, self.num_envs, self.device = task or ReachingCfg(), cfg.num_envs, cfg.device
        self.physics_hz = physics_hz
        self.generator = torch.Generator(cfg.device).manual_seed(cfg.seed)
        self.statistics = Statistics()
        self.num_steps, self.num_checks, self.is_closed = 0, 0, False
        self.staggered_resets: list[bool] = []
        self.position, self.goal = self._zeros(), self._zeros()
        self.time = self._zeros()
        self.buffers = observed(
            {name: self._zeros(size) for name, size in self.observation_sizes.items()}, self._zeros(3)
        )

    def reset(self, *, is_staggered: bool = False) -> Observation:
        self.staggered_resets.append(is_staggered)
        self._restart(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))
        return self._observe(self._zeros(2))

    def step(self, actions: dict[str, Tensor]) -> ReachingStep:
        assert all(action.dtype == torch.float32 for action in actions.values())
        arm, hand = (actions[name].clamp(-1.0, 1.0) for name in ("arm", "hand"))
        before = (self.position - self.goal).abs()
        self.position = self.position + 0.15 * (arm[:, 0] + hand[:, 0])
        now = (self.position - self.goal).abs()
        self.time += 1
        succeeded = now < 0.1
        timed_out = self.time >= EPISODE_STEPS
        reward = before - now + succeeded.float()
        rewards = {"arm": reward - 0.02 * arm.square().sum(-1), "hand": reward - 0.02 * hand.square().sum(-1)}
        done = succeeded | timed_out
        self.statistics.episodes += float(done.sum())
        self.statistics.successes += float(succeeded.sum())
        self._restart(done)
        self.num_steps += 1
        step = ReachingStep(self._observe(arm), rewards, succeeded, timed_out & ~succeeded)
        if self.num_steps == self.cfg.bad_step:
            self._spoil(step)
        return step

    def check(self) -> None:
        self.num_checks += 1

    def close(self) -> None:
        self.is_closed = True

    def _spoil(self, step: ReachingStep) -> None:
        agent, quantity = self.cfg.bad_quantity.split("/")
        values = {
            "reward": step.rewards.get(agent),
            "position": step.observation.policy["arm"][:, 1],
            "pixel": step.observation.policy["hand"][:, 0],
            "state": step.observation.state,
        }
        values[quantity][3] = float("nan")

    def _restart(self, done: Tensor) -> None:
        draw = torch.rand(2, self.num_envs, generator=self.generator, device=self.device) * 2 - 1
        self.goal = torch.where(done, draw[0], self.goal)
        self.position = torch.where(done, draw[1], self.position)
        self.time = torch.where(done, 0.0, self.time)

    def _observe(self, arm: Tensor) -> Observation:
        distance = self.goal - self.position
        columns = torch.stack((distance, self.position), -1)
        self.buffers.policy["arm"].copy_(torch.cat((columns, arm), -1))
        self.buffers.policy["hand"].copy_(torch.stack((320 + 200 * distance, torch.ones_like(distance)), -1))
        self.buffers.state.copy_(torch.stack((self.position, self.goal, self.time / EPISODE_STEPS), -1))
        return self.buffers

    def _zeros(self, *size: int) -> Tensor:
        return torch.zeros(self.num_envs, *size, device=self.device)


ReachingEnv: Any = _ReachingEnv
"""Stands in for `CatchEnv`."""


class TaughtEnv(ReachingEnv):
    """Its teacher sees what the agents see."""

    def _observe(self, arm: Tensor) -> Observation:
        observation = super()._observe(arm)
        return replace(observation, teacher=observation.policy)


def roll_out(mappo: Mappo, env: Any) -> None:
    observation = env.reset()
    for _ in range(mappo.cfg.rollout_steps):
        step = env.step(mappo.act(observation))
        mappo.record(step)
        observation = step.observation


def during_step(number: int, function: Callable[[], object]) -> Callable[..., Any]:
    """Make environments in which something happens at the beginning of a step."""

    class Env(ReachingEnv):
        def step(self, actions: dict[str, Tensor]) -> ReachingStep:
            if self.num_steps == number:
                function()
            return super().step(actions)

    return Env


def rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text())
