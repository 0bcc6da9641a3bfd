"""MAPPO: every agent learns by PPO on its own observations; its value network sees the whole state.

A method may give the value network the agent's observation instead (independent PPO).

Source: Yu et al. 2022, in the form of the release (skrl): clipped ratios and values, generalised advantages,
standardised inputs and values. Ours: imitation of a teacher, frozen policies, several processes.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor

from pixel2catch.envs.catch_env import CatchEnv, Observation, Step
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.distributed import Workers
from pixel2catch.learning.gradient_step import (
    EPSILON,
    ActorCritic,
    Batch,
    GradientStep,
    Standardizer,
    adapted_rate,
    learn_together,
    shuffled,
)
from pixel2catch.policy import Policy, PolicyContract
from pixel2catch.shipped import policy_folder
from pixel2catch.sim.graphs import GraphedFunction

ADOPTED_SAMPLES = 1e7
"""Samples that the input statistics of a policy count for where a training goes on from it. Source: ours."""

NUM_EAGER_CALLS = 1
"""Calls of a function before it is recorded: libraries initialise in the first. Source: ours."""

METRICS = ("policy_loss", "value_loss", "kl", "action_std", "learning_rate")
"""Metrics of an update, for every agent."""


class Mappo:
    """Acts, records and updates. Between two updates nothing waits for the device."""

    def __init__(
        self, cfg: TrainCfg, env: CatchEnv, contract: PolicyContract, workers: Workers | None = None
    ) -> None:
        """Build untrained networks; the global torch generator decides on their weights.

        Configuration and environments are those of this process; updates are one with those of all `workers`.
        """
        self.cfg, self.contract, self.workers = cfg, contract, workers or Workers(device=cfg.device)
        self.agents = tuple(contract.agents)
        self._is_local = env.method.value_input == "observation"
        sizes = env.observation_sizes if self._is_local else dict.fromkeys(self.agents, env.state_size)
        self.networks = {
            agent: ActorCritic(cfg, env.observation_sizes[agent], sizes[agent], num_actions)
            for agent, num_actions in env.action_sizes.items()
        }
        self._teacher = _load_teacher(cfg, contract) if cfg.teacher else None

        def buffer(*size: int, fill: float = torch.nan) -> Tensor:
            return torch.full((cfg.rollout_steps, env.num_envs, *size), fill, device=cfg.device)

        seen = {agent: buffer(env.observation_sizes[agent]) for agent in self.agents}
        states = seen if self._is_local else dict.fromkeys(self.agents, buffer(env.state_size))
        #: Input of every agent's value network after the last step.
        self.next_states = {agent: states[agent][0].clone() for agent in self.agents}
        self.is_done = buffer(fill=False)  #: Whether an episode ended at a step, (rollout_steps, num_envs).
        #: What every agent saw and did since the last update, (rollout_steps, num_envs, ...).
        self.rollout = {
            agent: Batch(
                observations=seen[agent],
                states=states[agent],
                actions=buffer(num_actions),
                log_prob=buffer(),
                values=buffer(),
                returns=buffer(),
                advantages=buffer(),
                teacher_actions=buffer(num_actions if self._teacher else 0),
            )
            for agent, num_actions in env.action_sizes.items()
        }
        self.steps = {
            name: GradientStep(cfg, each, self.rollout[name]) for name, each in self.networks.items()
        }
        self.rewards = {agent: buffer() for agent in self.agents}  #: (rollout_steps, num_envs).
        self._num_steps = 0
        stream = partial(torch.cuda.Stream, cfg.device) if cfg.device.startswith("cuda") else lambda: None
        self._streams = {agent: stream() for agent in self.agents}  #: On which each is differentiated.
        self._draw = {
            agent: self._recorded(torch.compile(networks.act, dynamic=False)) if cfg.fuse else networks.act
            for agent, networks in self.networks.items()
        }
        self.drop_recordings()

    def drop_recordings(self) -> None:
        """Drop recorded advantages and epochs; their collectives would keep the process group from ending."""
        self._estimate = self._recorded(self._estimate_advantages)
        self._epochs = [self._recorded(partial(self._epoch, is_first=is_first)) for is_first in (False, True)]

    def _recorded(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function as a single launch on a CUDA device, where small kernels wait for the host."""
        if not self.cfg.device.startswith("cuda"):
            return function
        device = torch.device(self.cfg.device)
        return GraphedFunction(function, device=device, num_eager_calls=NUM_EAGER_CALLS)

    @torch.no_grad()
    def act(self, observation: Observation) -> dict[str, Tensor]:
        """Sample unclipped actions, (num_envs, size) by agent; record them with their inputs."""
        actions = {}
        with _tensor_cores():
            for agent in self.agents:
                seen = {"observations": observation.policy[agent], "states": self._states(observation)[agent]}
                drawn = self._draw[agent](*seen.values())
                seen |= dict(zip(("actions", "log_prob", "values"), drawn, strict=True))
                actions[agent] = seen["actions"]
                for name, tensor in seen.items():
                    getattr(self.rollout[agent], name)[self._num_steps] = tensor
            if self._teacher is not None:
                self._query_teacher(self._teacher, observation)
        return actions

    def _states(self, observation: Observation) -> dict[str, Tensor]:
        """Return the input of every agent's value network, (num_envs, size)."""
        return observation.policy if self._is_local else dict.fromkeys(self.agents, observation.state)

    def _query_teacher(self, teacher: Policy, observation: Observation) -> None:
        """Record a teacher's actions; its agents may split the joints otherwise."""
        teacher_actions = {
            joint: action
            for agent, actions in teacher.act(observation.teacher).items()
            for joint, action in zip(teacher.contract.agents[agent].joints, actions.unbind(-1), strict=True)
        }
        for agent, batch in self.rollout.items():
            taught = [teacher_actions[joint] for joint in self.contract.agents[agent].joints]
            batch.teacher_actions[self._num_steps] = torch.stack(taught, dim=-1)

    def record(self, step: Step) -> None:
        """Record the outcome of the last actions. A time-out ends an episode like any other end (paper)."""
        for agent in self.agents:
            self.rewards[agent][self._num_steps] = step.rewards[agent]
        self.is_done[self._num_steps] = step.terminated | step.truncated
        self.next_states = self._states(step.observation)
        self._num_steps += 1

    def discard_rollout(self) -> None:
        """Discard the transitions since the last update."""
        self._num_steps = 0

    def named(self, metrics: Iterable[Iterable[Any]]) -> dict[str, Any]:
        """Return metrics by name, from the `METRICS` of every agent."""
        return {
            f"{name}/{agent}": value
            for agent, row in zip(self.agents, metrics, strict=True)
            for name, value in zip(METRICS, row, strict=True)
        }

    def update(self, progress: float) -> Tensor:
        """Launch an update; return the `METRICS`, a row per agent. Only the kl schedule waits."""
        cfg = self.cfg
        taught = min(progress / cfg.teacher_share, 1.0) if cfg.teacher_share else 1.0
        begun = progress * cfg.transitions / cfg.start_transitions if cfg.start else 2.0
        for step in self.steps.values():
            step.freeze_policy(begun < 1.0)
            step.teacher_weight.fill_(1.0 - taught * (1.0 - cfg.final_teacher_weight))
            if cfg.schedule == "linear":
                rate = cfg.learning_rate + (cfg.final_learning_rate - cfg.learning_rate) * min(progress, 1.0)
                step.learning_rate.fill_(rate * (begun - 1.0 if 1.0 <= begun < 2.0 else 1.0))
        with _tensor_cores():
            metrics = self._update_agents()
        self.discard_rollout()
        return metrics

    def _update_agents(self) -> Tensor:
        cfg, steps = self.cfg, self.steps.values()
        self._estimate(*self.next_states.values())
        epochs = []
        for epoch in range(cfg.epochs):
            epochs.append(self._epochs[epoch == 0]().clone())
            if cfg.schedule == "kl":
                for step, kl in zip(steps, epochs[-1][:, 2].tolist(), strict=True):
                    if not step.is_frozen:
                        step.learning_rate.fill_(adapted_rate(cfg, step.learning_rate.item(), kl))
        stds = [networks.log_std.detach().exp().mean() for networks in self.networks.values()]
        rest = torch.stack((torch.stack(stds), torch.stack([step.learning_rate for step in steps])), dim=-1)
        return torch.cat((torch.stack(epochs).mean(dim=0), rest), dim=-1)

    def _epoch(self, *, is_first: bool) -> Tensor:
        """Pass over the rollout and return mean losses; the first epoch also updates the input scales."""
        for step in self.steps.values():
            step.totals.zero_()
        orders = {agent: shuffled(self.cfg) for agent in self.agents}
        for agent, step in self._side_by_side():
            step.shuffle(orders[agent])
        for number in range(self.cfg.mini_batches):
            if is_first:
                self._learn_scales(number)
            for _, step in self._side_by_side():
                step.differentiate(number)
            self.workers.average([part for step in self.steps.values() for part in step.exchanged])
            for _, step in self._side_by_side():
                step.apply()
        return torch.stack([step.totals for step in self.steps.values()]) / self.cfg.mini_batches

    def _side_by_side(self) -> Iterator[tuple[str, GradientStep]]:
        """Yield every agent and its gradient steps, on a CUDA device each in its own stream."""
        for agent, stream in self._streams.items():
            if stream:
                stream.wait_stream(torch.cuda.current_stream(stream.device))
            with torch.cuda.stream(stream):
                yield agent, self.steps[agent]
        for stream in filter(None, self._streams.values()):
            torch.cuda.current_stream(stream.device).wait_stream(stream)

    def _learn_scales(self, number: int) -> None:
        seen: list[tuple[Standardizer, Tensor]] = []
        for agent, networks in self.networks.items():
            batch = self.steps[agent].batch(number)
            seen += [(networks.observation_scale, batch.observations), (networks.state_scale, batch.states)]
        learn_together(self.workers, seen)

    @torch.no_grad()
    def _estimate_advantages(self, *next_states: Tensor) -> None:
        """Compute returns and advantages; standardise first the values, then the returns."""
        found: list[tuple[Tensor, Tensor, Tensor]] = []
        for (agent, rollout), states in zip(self.rollout.items(), next_states, strict=True):
            last = self.networks[agent].value_of(states)
            returns = discounted_returns(self.cfg, self.rewards[agent], self.is_done, rollout.values, last)
            found.append((returns - rollout.values, rollout.values, returns))
        parts = [(each.mean(), each.var()) for agent in found for each in agent]
        moments = iter(self.workers.moments(parts, self.is_done.numel()))
        for agent, (advantages, values, returns) in zip(self.agents, found, strict=True):
            rollout, scale = self.rollout[agent], self.networks[agent].value_scale
            mean, variance = (moment.to(values) for moment in next(moments))
            rollout.advantages.copy_((advantages - mean) / (variance.sqrt() + EPSILON))
            for target, seen in ((rollout.values, values), (rollout.returns, returns)):
                scale.learn(*next(moments), seen.numel() * self.workers.size)
                target.copy_(scale(seen))

    @torch.no_grad()
    def export(self) -> Policy:
        """Copy mean networks and input statistics into a `Policy` on the CPU."""
        policy = Policy(self.contract, self.cfg.hidden)
        for agent, networks in self.networks.items():
            target = policy.network(agent)
            target.network.load_state_dict(networks.policy.state_dict())
            target.input_mean.copy_(networks.observation_scale.mean)
            target.input_std.copy_(networks.observation_scale.std)
        return policy.eval()

    @torch.no_grad()
    def adopt(self, policy: Policy) -> None:
        """Take over the networks and the input statistics of a policy: the inverse of `export`."""
        if policy.hidden != tuple(self.cfg.hidden):
            raise InvalidValueError(
                f"the policy to start from has hidden layers {policy.hidden}; train with --hidden "
                f"{' '.join(map(str, policy.hidden))}, or start from another."
            )
        for agent, networks in self.networks.items():
            source, scale = policy.network(agent), networks.observation_scale
            networks.policy.load_state_dict(source.network.state_dict())
            scale.mean.copy_(source.input_mean)
            scale.variance.copy_((source.input_std.double() - EPSILON).square())
            scale.count.fill_(ADOPTED_SAMPLES)

    def state_dict(self) -> dict[str, dict[str, Any]]:
        """Return networks, statistics and optimisers, by agent."""
        return {
            agent: {
                "networks": self.networks[agent].state_dict(),
                "optimizer": self.steps[agent].optimizer.state_dict(),
            }
            for agent in self.agents
        }

    def load_state_dict(self, state: dict[str, dict[str, Any]]) -> None:
        """Restore what `state_dict` returned."""
        for agent in self.agents:
            self.networks[agent].load_state_dict(state[agent]["networks"])
            self.steps[agent].load_state_dict(state[agent]["optimizer"])
        self.drop_recordings()


def _load_teacher(cfg: TrainCfg, contract: PolicyContract) -> Policy:
    assert cfg.teacher is not None
    teacher = Policy.load(policy_folder(cfg.teacher), cfg.device)
    taught, own = (
        {joint for agent in each.agents.values() for joint in agent.joints}
        for each in (teacher.contract, contract)
    )
    if taught != own:
        raise PolicyMismatchError(
            f"the teacher '{cfg.teacher}' was trained for '{teacher.contract.workcell}'; not both move "
            f"{', '.join(sorted(taught ^ own))}. Take one that was trained for '{contract.workcell}'."
        )
    return teacher


def discounted_returns(
    cfg: TrainCfg, rewards: Tensor, is_done: Tensor, values: Tensor, last_values: Tensor
) -> Tensor:
    """Return value plus generalised advantage of every step, (rollout_steps, num_envs).

    Values are those of the states before each step, the last ones (num_envs,) of those after the last step.
    Source: Schulman et al. 2016.
    """
    returns, advantage = torch.empty_like(values), torch.zeros_like(last_values)
    for t in reversed(range(len(rewards))):
        ahead = last_values + cfg.gae_lambda * advantage
        advantage = rewards[t] - values[t] + cfg.discount * ~is_done[t] * ahead
        returns[t], last_values = advantage + values[t], values[t]
    return returns


@contextmanager
def _tensor_cores() -> Iterator[None]:
    """Let matrix products of the networks round to TF32 on CUDA; elsewhere (kinematics) they must not."""
    matmul = torch.backends.cuda.matmul
    before, matmul.allow_tf32 = matmul.allow_tf32, True
    try:
        yield
    finally:
        matmul.allow_tf32 = before
