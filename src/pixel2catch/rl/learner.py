"""Learner: MAPPO behind the few verbs that the training loop needs."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import torch
from torch import Tensor

from pixel2catch.errors import InvalidValueError
from pixel2catch.policy import Policy, PolicyContract
from pixel2catch.rl.config import TrainCfg
from pixel2catch.rl.environment import Environment, Observation, Step
from pixel2catch.rl.graph_mappo import ADVICE, METRICS
from pixel2catch.rl.mappo import build_mappo
from pixel2catch.rl.memory import RolloutMemory
from pixel2catch.rl.models import GaussianPolicy, ValueFunction
from pixel2catch.rl.workers import OneProcess, Workers

ADOPTED_SAMPLES = 1e7
"""Samples that the input statistics of a policy count for where a training goes on from it. Source: ours."""


class Learner:
    """Acts, remembers and updates. Between two updates nothing waits for the device."""

    def __init__(self, cfg: TrainCfg, env: Environment, workers: Workers | None = None) -> None:
        """Build untrained networks; the global torch generator decides on their weights.

        Args:
            cfg: The configuration of this process.
            env: The environments of this process.
            workers: All processes, whose updates are one; this one alone if absent.
        """
        self.cfg, self.workers = cfg, workers or OneProcess(cfg.device)
        self.mappo = build_mappo(cfg, env, self.workers)
        self.agents = tuple(env.action_sizes)
        self.models = cast(dict[str, dict[str, GaussianPolicy | ValueFunction]], self.mappo.models)
        self.memories = cast(dict[str, RolloutMemory], self.mappo.memories)
        self._is_resting = False
        self._teacher = Policy.load(cfg.teacher, cfg.device) if cfg.teacher else None
        if self._teacher is not None:
            self.mappo.expect_advice()
        self._never = torch.zeros(env.num_envs, 1, dtype=torch.bool, device=cfg.device)

    @torch.no_grad()
    def act(self, observation: Observation) -> dict[str, Tensor]:
        """Sample unclipped actions, (num_envs, size) by agent, and remember their probabilities."""
        with _tensor_cores():
            actions, _ = self.mappo.act(
                observation.policy, self._states(observation), timestep=0, timesteps=0
            )
            if self._teacher is not None:
                advice = torch.cat(list(self._teacher.act(observation.teacher).values()), dim=-1)
                sizes = [actions[agent].shape[-1] for agent in self.agents]
                for agent, share in zip(self.agents, advice.split(sizes, dim=-1), strict=True):
                    self.memories[agent].extra = {ADVICE: share}
        return actions

    def record(
        self, policy: dict[str, Tensor], state: Tensor, actions: dict[str, Tensor], step: Step
    ) -> None:
        """Remember a transition.

        A time-out ends the episode like any other end (paper): skrl lets advantages leak across `truncated`.

        Args:
            policy: Policy inputs before the step, by agent.
            state: Value input before the step.
            actions: What `act` returned.
            step: What the environment returned.
        """
        is_done = (step.terminated | step.truncated).unsqueeze(-1)
        self.mappo.record_transition(
            observations=policy,
            states=dict.fromkeys(self.agents, state),
            actions=actions,
            rewards={agent: step.rewards[agent].unsqueeze(-1) for agent in self.agents},
            next_observations=step.observation.policy,
            next_states=dict.fromkeys(self.agents, step.observation.state),
            terminated=dict.fromkeys(self.agents, is_done),
            truncated=dict.fromkeys(self.agents, self._never),
            infos={},
            timestep=0,
            timesteps=0,
        )

    def update(self, progress: float) -> dict[str, float]:
        """Learn from the full memory and return the losses.

        Args:
            progress: Share of the training that is over, 0 to 1.
        """
        begun = progress * self.cfg.transitions / self.cfg.start_transitions if self.cfg.start else 2.0
        self._rest_policies(begun < 1.0)
        for step in self.mappo.steps.values():
            share = self.cfg.teacher_share
            step.teacher_weight.fill_(1.0 - progress / share if progress < share else 0.0)
        if self.cfg.schedule == "linear":
            is_rising = 1.0 <= begun < 2.0
            self._set_learning_rate(progress, begun - 1.0 if is_rising else 1.0)
        with _tensor_cores():
            self.mappo.post_interaction(timestep=0, timesteps=0)
        return self._pop_metrics()

    def discard_rollout(self) -> None:
        """Forget the transitions since the last update."""
        for memory in self.memories.values():
            memory.reset()

    def close(self) -> None:
        """Release what would keep the process group from ending."""
        for step in self.mappo.steps.values():
            step.close()

    @torch.no_grad()
    def export(self, contract: PolicyContract) -> Policy:
        """Copy mean networks and input statistics into a `Policy` on the CPU."""
        policy = Policy(contract, self.cfg.hidden)
        for agent in self.agents:
            target, scaler = policy.network(agent), self.mappo._observation_preprocessor[agent]
            target.network.load_state_dict(self.models[agent]["policy"].network.state_dict())
            target.input_mean.copy_(scaler.running_mean)
            target.input_std.copy_(scaler.running_variance.float().sqrt() + scaler.epsilon)
        return policy.eval()

    @torch.no_grad()
    def adopt(self, policy: Policy) -> None:
        """Go on from the networks and the input statistics of a policy: the inverse of `export`.

        Raises:
            InvalidValueError: Its hidden layers have other sizes.
        """
        if policy.hidden != tuple(self.cfg.hidden):
            raise InvalidValueError(
                f"the policy to start from has hidden layers {policy.hidden}; train with --hidden "
                f"{' '.join(map(str, policy.hidden))}, or start from another."
            )
        for agent in self.agents:
            source, scaler = policy.network(agent), self.mappo._observation_preprocessor[agent]
            self.models[agent]["policy"].network.load_state_dict(source.network.state_dict())
            scaler.running_mean.copy_(source.input_mean)
            scaler.running_variance.copy_((source.input_std.double() - scaler.epsilon).square())
            scaler.current_count.fill_(ADOPTED_SAMPLES)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that learning goes on from: networks, optimisers and statistics, by agent."""
        return {
            agent: {name: module.state_dict() for name, module in modules.items()}
            for agent, modules in self.mappo.checkpoint_modules.items()
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` returned."""
        for agent, modules in self.mappo.checkpoint_modules.items():
            for name, module in modules.items():
                module.load_state_dict(state[agent][name])
            self.mappo.steps[agent].on_restored()

    def _states(self, observation: Observation) -> dict[str, Tensor | None]:
        return {agent: observation.state for agent in self.agents}

    def _set_learning_rate(self, progress: float, share: float) -> None:
        first, last = self.cfg.learning_rate, self.cfg.final_learning_rate
        for step in self.mappo.steps.values():
            step.learning_rate.fill_(share * (first + (last - first) * min(progress, 1.0)))

    def _rest_policies(self, is_resting: bool) -> None:
        """Let the value networks alone learn, so that a policy is not led by values that mean nothing yet."""
        for step in self.mappo.steps.values():
            if is_resting:
                step.rest_policy()
            elif self._is_resting:
                step.wake_policy()
        self._is_resting = is_resting

    def _pop_metrics(self) -> dict[str, float]:
        tracked = {name: values[-1] for name, values in self.mappo.tracking_data.items()}
        self.mappo.tracking_data.clear()
        return {f"{name}/{agent}": tracked[f"{name}/{agent}"] for agent in self.agents for name in METRICS}


@contextmanager
def _tensor_cores() -> Iterator[None]:
    """Let matrix products of the networks round to TF32 on CUDA; elsewhere (kinematics) they must not."""
    matmul = torch.backends.cuda.matmul
    before, matmul.allow_tf32 = matmul.allow_tf32, True
    try:
        yield
    finally:
        matmul.allow_tf32 = before
