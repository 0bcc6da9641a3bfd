"""What training needs of environments (`CatchEnv` has it), and how they change with the physics rate."""

from collections.abc import Callable
from typing import Protocol

from torch import Tensor

from pixel2catch.envs.catch_env import Observation
from pixel2catch.errors import PolicyMismatchError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.policy import PolicyContract


class Outcome(Protocol):
    """What learning needs of a control step; where an episode ended, `observation` is of the next one."""

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
    def statistics(self) -> Statistics:
        """Episode statistics since the last look."""
        ...

    def reset(self, *, is_staggered: bool = False) -> Observation:
        """Begin new episodes everywhere; where they are staggered, such that they will not end together."""
        ...

    def step(self, actions: dict[str, Tensor]) -> Outcome:
        """Act for one control step. Actions outside [-1, 1] are clipped by the environment."""
        ...

    def check(self) -> None:
        """Raise if the simulation lost something since the last call; may wait for the device."""
        ...

    def close(self) -> None:
        """Release what the environment holds."""
        ...


class EnvSchedule:
    """Environments that are made again where the physics rate changes in the course of a training."""

    def __init__(
        self,
        cfg: TrainCfg,
        make_env: Callable[[TrainCfg, float | None], Environment],
        contract: PolicyContract,
        transitions: int = 0,
    ) -> None:
        """Make the environments that follow some transitions, for this process's share of the configuration.

        Args:
            cfg: The share of this process.
            make_env: Makes environments at a physics rate [1/s], or at their own with None.
            contract: What they must fit.
            transitions: How far the training is.

        Raises:
            PolicyMismatchError: They do not fit the contract; the message names the field.
        """
        self._cfg, self._make_env, self._contract = cfg, make_env, contract
        self._rate = cfg.rate_at(transitions)
        self.env = self._make()  #: The environments at the present rate.

    def enter(self, transitions: int) -> bool:
        """Change to the rate that follows this many transitions; return whether the environments are new."""
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
        env = self._make_env(self._cfg, self._rate)
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
                f"{name}: configuration and contract have {expected}, the environments {found}."
            )
