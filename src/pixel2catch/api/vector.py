"""Catching environments of a single agent behind Gymnasium's APIs: several side by side, or one."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy import ndarray

from pixel2catch.api.arrays import METADATA, Pictures, action_tensor, array, outcome, space
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.errors import InvalidValueError


def only_agent(env: CatchEnv) -> str:
    """Return the name of the only agent of an environment.

    Raises:
        InvalidValueError: There are several.
    """
    names = [agent.name for agent in env.method.agents]
    if len(names) != 1:
        raise InvalidValueError(
            f"method '{env.method.name}' has the agents {', '.join(names)}; Gymnasium has one: make "
            "'single_agent' or 'catch_alone', or take CatchParallelEnv."
        )
    return names[0]


class CatchVectorEnv(VectorEnv[ndarray, ndarray, ndarray]):
    """Robots side by side, with one agent each.

    Where an episode ends, `step` returns the first observation of the next one: every end is a termination
    (paper), so that no learner needs the last observation.
    """

    metadata: ClassVar[dict[str, Any]] = {**METADATA, "autoreset_mode": AutoresetMode.SAME_STEP}  # pyright: ignore[reportIncompatibleVariableOverride] (Gymnasium's is a mutable class variable, too)

    def __init__(self, env: CatchEnv, render_mode: str | None = None) -> None:
        """Wrap environments, such as `pixel2catch.make("single_agent", num_envs=64)`.

        Raises:
            InvalidValueError: Their method has several agents.
        """
        self._env, self._agent = env, only_agent(env)
        self.num_envs, self.render_mode = env.num_envs, render_mode
        self._pictures = Pictures(env, render_mode)
        self.single_observation_space = space(env.observation_sizes[self._agent])
        self.single_action_space = space(env.action_sizes[self._agent], bound=1.0)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.action_space = batch_space(self.single_action_space, env.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Start all episodes; without a seed the random generator goes on. `options` are ignored."""
        super().reset(seed=seed)
        if seed is not None:
            self._env.seed(seed)
        return array(self._env.reset().policy[self._agent]), {}

    def step(self, actions: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray, dict[str, Any]]:
        """Act for one control step; actions are clipped to [-1, 1].

        Infos hold the entries of `outcome` for episodes that ended; their masks begin with an underscore.

        Raises:
            InvalidValueError: Actions have another shape, or one is NaN.
        """
        step = self._env.step({self._agent: action_tensor(self._env, self._agent, actions)})
        ended = array(step.terminated)
        infos: dict[str, Any] = {}
        if ended.any():
            for name, values in outcome(step).items():
                infos |= {name: np.where(ended, values, 0).astype(values.dtype), f"_{name}": ended.copy()}
        return (
            array(step.observation.policy[self._agent]),
            array(step.rewards[self._agent]),
            ended,
            array(step.truncated),
            infos,
        )

    def render(self) -> tuple[ndarray, ...] | None:
        """Return a picture (height, width, 3) of every environment with the mode "rgb_array", else None."""
        pictures = self._pictures.draw()
        return None if pictures is None else tuple(pictures)

    def close_extras(self, **_: Any) -> None:
        """Free simulation and pictures."""
        self._pictures.close()
        self._env.close()


class CatchSingleEnv(gymnasium.Env[ndarray, ndarray]):
    """A single robot with one agent; the only row of a `CatchVectorEnv`."""

    metadata: ClassVar[dict[str, Any]] = dict(METADATA)  # pyright: ignore[reportIncompatibleVariableOverride] (Gymnasium's is a mutable class variable, too)

    def __init__(self, env: CatchEnv, render_mode: str | None = None) -> None:
        """Wrap an environment, such as `pixel2catch.make("single_agent")`.

        Raises:
            InvalidValueError: There are several environments or agents.
        """
        if env.num_envs != 1:
            raise InvalidValueError(f"num_envs is {env.num_envs}; it must be 1, or take CatchVectorEnv.")
        self._vector = CatchVectorEnv(env, render_mode)
        self.render_mode = render_mode
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Start an episode; without a seed the random generator goes on. `options` are ignored."""
        super().reset(seed=seed)
        return self._vector.reset(seed=seed)[0][0], {}

    def step(self, action: ndarray) -> tuple[ndarray, float, bool, bool, dict[str, Any]]:
        """Act for one control step; the action is clipped to [-1, 1].

        The infos of the last step of an episode hold `is_tracked`, `is_success` and `episode_steps`.

        Raises:
            InvalidValueError: The action has another shape, or is NaN.
        """
        observation, reward, terminated, truncated, infos = self._vector.step(np.asarray(action)[None])
        summary = {name: values[0].item() for name, values in infos.items() if not name.startswith("_")}
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), summary

    def render(self) -> Any:
        """Return a picture (height, width, 3) with the render mode "rgb_array", else None."""
        pictures = self._vector.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Free simulation and pictures."""
        self._vector.close()
