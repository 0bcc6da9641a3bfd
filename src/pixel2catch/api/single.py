"""One catching environment of a single agent behind Gymnasium's API."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy import ndarray

from pixel2catch.api.arrays import METADATA
from pixel2catch.api.vector import CatchVectorEnv
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.errors import InvalidValueError


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
