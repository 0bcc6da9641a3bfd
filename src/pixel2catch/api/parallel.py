"""One catching environment behind PettingZoo's parallel API, for other libraries' learners.

    env = CatchParallelEnv(pixel2catch.make("proposed", seed=0))
    observations, infos = env.reset()
    while env.agents:
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        observations, rewards, terminations, truncations, infos = env.step(actions)

The API is followed without importing PettingZoo, which is no dependency of this package.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy import ndarray
from torch import Tensor

from pixel2catch.api.arrays import METADATA, Pictures, action_tensor, array, outcome, space
from pixel2catch.envs.catch_env import CatchEnv, Observation
from pixel2catch.errors import InvalidValueError, UnknownNameError

Arrays = dict[str, ndarray]
Values = dict[str, Any]


class CatchParallelEnv:
    """A single robot; its agents act at the same time.

    A time-out counts as a termination (paper), so nothing is ever truncated. With the end of an episode come
    observation and state of the next one; a learner that follows the API does not use them.

    Attributes:
        metadata: Name of the environment, and how it renders.
        possible_agents: Names of all agents.
        agents: The same during an episode; empty after its end.
        state_space: Space of `state`, the input of the value networks.
    """

    metadata: ClassVar[Values] = {**METADATA, "is_parallelizable": True}

    def __init__(self, env: CatchEnv, render_mode: str | None = None) -> None:
        """Wrap an environment, such as `pixel2catch.make("proposed")`.

        Raises:
            InvalidValueError: There are several.
        """
        if env.num_envs != 1:
            raise InvalidValueError(f"num_envs is {env.num_envs}; it must be 1 for PettingZoo.")
        self._env, self._pictures, self.render_mode = env, Pictures(env, render_mode), render_mode
        self.possible_agents = [agent.name for agent in env.method.agents]
        self.agents: list[str] = []
        self._observation_spaces = {name: space(size) for name, size in env.observation_sizes.items()}
        self._action_spaces = {name: space(size, bound=1.0) for name, size in env.action_sizes.items()}
        self.state_space = space(env.state_size)
        self._state = np.zeros(env.state_size, dtype=np.float32)

    @property
    def num_agents(self) -> int:
        """Number of agents in the present episode."""
        return len(self.agents)

    @property
    def max_num_agents(self) -> int:
        """Number of all agents."""
        return len(self.possible_agents)

    @property
    def unwrapped(self) -> "CatchParallelEnv":
        """The environment itself."""
        return self

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observation."""
        return self._observation_spaces[self._known(agent)]

    def action_space(self, agent: str) -> Box:
        """Return the space of an agent's actions, each in [-1, 1]."""
        return self._action_spaces[self._known(agent)]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Arrays, Values]:
        """Start an episode; return observation (size,) float32 and empty info of each agent.

        Without a seed the random generator goes on. `options` are ignored, as the API allows.
        """
        if seed is not None:
            self._env.seed(seed)
        self.agents = list(self.possible_agents)
        return self._observe(self._env.reset()), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, ndarray]) -> tuple[Arrays, Values, Values, Values, Values]:
        """Act for one control step; actions (num_joints,) are clipped to [-1, 1].

        Return observations, rewards, terminations, truncations and infos of each agent; all are empty after
        the end of an episode. The infos of its last step hold `is_tracked`, `is_success` and `episode_steps`.

        Raises:
            InvalidValueError: An action is missing, of another size, or NaN.
        """
        if not self.agents:
            return {}, {}, {}, {}, {}
        acting = {agent: self._action(agent, actions) for agent in self.agents}
        step = self._env.step(acting)
        is_over = bool(step.terminated.item())
        names = list(self.agents)
        infos = {name: values[0].item() for name, values in outcome(step).items()} if is_over else {}
        if is_over:
            self.agents = []
        return (
            self._observe(step.observation),
            {agent: float(step.rewards[agent].item()) for agent in names},
            dict.fromkeys(names, is_over),
            dict.fromkeys(names, bool(step.truncated.item())),
            {agent: dict(infos) for agent in names},
        )

    def state(self) -> ndarray:
        """Return the input of the value networks at the last observation, (state_size,) float32."""
        return self._state.copy()

    def render(self) -> ndarray | None:
        """Return a picture (height, width, 3) with the render mode "rgb_array", else None."""
        pictures = self._pictures.draw()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Free simulation and pictures."""
        self.agents = []
        self._pictures.close()
        self._env.close()

    def _known(self, agent: str) -> str:
        if agent not in self.possible_agents:
            raise UnknownNameError("agent", agent, self.possible_agents)
        return agent

    def _action(self, agent: str, actions: Mapping[str, ndarray]) -> Tensor:
        if agent not in actions:
            raise InvalidValueError(
                f"no action for agent '{agent}'; each step needs {', '.join(self.agents)}"
            )
        return action_tensor(self._env, agent, np.asarray(actions[agent])[None])

    def _observe(self, observation: Observation) -> Arrays:
        self._state = array(observation.state)[0]
        return {agent: array(value)[0] for agent, value in observation.policy.items()}
