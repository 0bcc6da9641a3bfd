"""What training needs of environments (`CatchEnv` has it), which are made anew where the physics changes."""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from pixel2catch.errors import PolicyMismatchError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.policy import PolicyContract


class Observation(Protocol):
    """Inputs of the networks, float32 on the environment's device."""

    @property
    def policy(self) -> dict[str, Tensor]:
        """Input of every agent's policy, (num_envs, size of that agent)."""
        ...

    @property
    def state(self) -> Tensor:
        """Input of all value networks, (num_envs, state_size)."""
        ...

    @property
    def teacher(self) -> dict[str, Tensor]:
        """Input of a teacher's policies, likewise; empty without a teacher."""
        ...


class Step(Protocol):
    """Result of a control step. Where an episode ended, `observation` is that of the next one."""

    @property
    def observation(self) -> Observation:
        """Observation after the step."""
        ...

    @property
    def rewards(self) -> dict[str, Tensor]:
        """Reward of every agent, (num_envs,)."""
        ...

    @property
    def terminated(self) -> Tensor:
        """Whether the episode ended, (num_envs,) bool."""
        ...

    @property
    def truncated(self) -> Tensor:
        """Whether the episode was cut off, (num_envs,) bool."""
        ...


class Statistics(Protocol):
    """Episode statistics, accumulated on the device."""

    def pop(self, total: Callable[[Tensor], Tensor], largest: Callable[[Tensor], Tensor]) -> dict[str, float]:
        """Return the statistics since the last call; the keys are always the same.

        `total` adds up the same sums of all processes and is called once; `largest` finds the largest of the
        same maxima and is called once at the most.
        """
        ...


class Environment(Protocol):
    """Many copies of a task, stepped together. `step` never waits for the device."""

    num_envs: int
    observation_sizes: dict[str, int]
    state_size: int
    action_sizes: dict[str, int]

    @property
    def cfg(self) -> Any:
        """Configuration, a dataclass; written into the run folder."""
        ...

    @property
    def statistics(self) -> Statistics:
        """Episode statistics since the last look."""
        ...

    def reset(self, *, is_staggered: bool = False) -> Observation:
        """Begin new episodes everywhere; where they are staggered, such that they will not end together."""
        ...

    def step(self, actions: dict[str, Tensor]) -> Step:
        """Act for one control step. Actions outside [-1, 1] are clipped by the environment."""
        ...

    def check(self) -> None:
        """Raise if the simulation lost something since the last call; may wait for the device."""
        ...

    def close(self) -> None:
        """Release what the environment holds."""
        ...


class EnvSchedule:
    """Environments whose physics becomes finer in the course of a training."""

    def __init__(
        self, cfg: TrainCfg, make_env: Callable[[TrainCfg], Environment], contract: PolicyContract
    ) -> None:
        """Make the environments of the first rate, for this process's share of the configuration.

        The `physics_hz` that `make_env` is given has one rate.

        Raises:
            PolicyMismatchError: They do not fit the contract; the message names the field.
        """
        self._cfg, self._make_env, self._contract = cfg, make_env, contract
        self._rate = cfg.rate_at(0)
        self.env = self._make()  #: The environments of the present rate.

    def enter(self, transitions: int) -> bool:
        """Change to the rate that follows this many transitions; whether the environments are new."""
        rate = self._cfg.rate_at(transitions)
        if rate == self._rate:
            return False
        self.env.close()
        self._rate = rate
        self.env = self._make()
        return True

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def _make(self) -> Environment:
        env = self._make_env(dataclasses.replace(self._cfg, physics_hz=(self._rate,)))
        try:
            _require_fit(self._cfg, env, self._contract)
        except PolicyMismatchError:
            env.close()
            raise
        return env


def _require_fit(cfg: TrainCfg, env: Environment, contract: PolicyContract) -> None:
    sizes = {
        "num_envs": (cfg.num_envs, env.num_envs),
        "observation_sizes": (
            {name: agent.num_inputs for name, agent in contract.agents.items()},
            env.observation_sizes,
        ),
        "action_sizes": (
            {name: len(agent.joints) for name, agent in contract.agents.items()},
            env.action_sizes,
        ),
    }
    for name, (expected, found) in sizes.items():
        if expected != found:
            raise PolicyMismatchError(
                f"{name}: configuration and contract say {expected}, the environment {found}."
            )
