"""What the learner needs of an environment. `CatchEnv` has it."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
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


@runtime_checkable
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


@runtime_checkable
class Statistics(Protocol):
    """Episode statistics, accumulated on the device."""

    def pop(self, total: Callable[[Tensor], Tensor], largest: Callable[[Tensor], Tensor]) -> dict[str, float]:
        """Return the statistics since the last call; the keys are always the same.

        Args:
            total: Adds up the same sums of all processes; called once.
            largest: Finds the largest of the same maxima of all processes; called once at the most.
        """
        ...


@runtime_checkable
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

    def reset(self) -> Observation:
        """Begin new episodes everywhere."""
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
