"""Views of a catching environment for other libraries: Gymnasium (one agent) and PettingZoo (all agents).

    env = CatchParallelEnv(pixel2catch.make("proposed", seed=0))
    observations, infos = env.reset()
    while env.agents:
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        observations, rewards, terminations, truncations, infos = env.step(actions)

PettingZoo's parallel API is followed without importing PettingZoo, which is no dependency of this package.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import UInt8
from numpy import ndarray
from torch import Tensor

from pixel2catch.checks import require
from pixel2catch.envs.catch_env import CatchEnv, Observation, Step
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.rendering.film import WIDE
from pixel2catch.rendering.renderer import Renderer
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import build_model

Arrays = dict[str, ndarray]
Values = dict[str, Any]

RENDER_MODE = "rgb_array"  #: The only one, besides None for no pictures.
METADATA: Values = {"name": "pixel2catch", "render_modes": [RENDER_MODE], "render_fps": round(1 / CONTROL_DT)}


def space(size: int, bound: float = np.inf) -> Box:
    """Return the space of vectors of a size, with entries within a bound."""
    return Box(-bound, bound, (size,), np.float32)


def array(values: Tensor) -> ndarray:
    """Copy values into an array."""
    return values.detach().cpu().numpy().copy()


def action_tensor(env: CatchEnv, actions: Any) -> Tensor:
    """Return actions (num_envs, num_joints) of an agent as a tensor."""
    try:
        return torch.tensor(np.asarray(actions, dtype=np.float32), device=env.device)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"an action is no array of numbers ({error}).") from error


def outcome(step: Step) -> Arrays:
    """Return the results of the episodes, (num_envs,)."""
    record = step.record
    found = {"is_tracked": record.is_tracked, "is_success": record.is_success, "episode_steps": record.steps}
    return {name: array(values) for name, values in found.items()}


def _require_env(env: Any, one: str = "") -> None:
    """Raise InvalidValueError for what is no environment, or several where there must be one."""
    require(CatchEnv, "env", env)
    if one and env.num_envs != 1:
        raise InvalidValueError(f"num_envs is {env.num_envs}; {one}.")


class Pictures:
    """Pictures of environments from outside."""

    def __init__(self, env: CatchEnv, render_mode: str | None) -> None:
        """Check the render mode; raise UnknownNameError for another one."""
        if render_mode not in (None, RENDER_MODE):
            raise UnknownNameError("render mode", render_mode, [RENDER_MODE])
        self._env, self._is_drawing = env, render_mode is not None
        self._renderers: dict[int, Renderer] = {}  # by object

    def draw(self) -> tuple[UInt8[ndarray, "height width 3"], ...] | None:
        """Return a picture of each environment, or None without a render mode."""
        if not self._is_drawing:
            return None
        ids, pictures = self._env.episode.parameters.object_id.tolist(), []
        for row, qpos in zip(ids, array(self._env.world.simulation.bind("qpos")), strict=True):
            if row not in self._renderers:
                scene = replace(self._env.cfg.scene, visuals=True)
                self._renderers[row] = Renderer(build_model(scene, self._env.world.objects.names[row]), WIDE)
            pictures.append(self._renderers[row].image(qpos))
        return tuple(pictures)

    def close(self) -> None:
        """Free simulation and drawing contexts."""
        while self._renderers:
            self._renderers.popitem()[1].close()
        self._env.close()


class CatchVectorEnv(VectorEnv[ndarray, ndarray, ndarray]):
    """Robots side by side, with one agent each.

    Where an episode ends, `step` returns the first observation of the next one: every end is a termination
    (paper), so that no learner needs the last observation.
    """

    metadata: ClassVar[Values] = {**METADATA, "autoreset_mode": AutoresetMode.SAME_STEP}  # pyright: ignore[reportIncompatibleVariableOverride] (Gymnasium's is a mutable class variable, too)

    def __init__(self, env: CatchEnv, render_mode: str | None = None) -> None:
        """Wrap environments, such as `pixel2catch.make("single_agent", num_envs=64)`, of a single agent."""
        _require_env(env)
        self._agent, *others = [agent.name for agent in env.method.agents]
        if others:
            raise InvalidValueError(
                f"method '{env.method.name}' has the agents {', '.join([self._agent, *others])}; Gymnasium "
                "has one: make 'single_agent' or 'catch_alone', or take CatchParallelEnv."
            )
        self._env, self.num_envs, self.render_mode = env, env.num_envs, render_mode
        self._pictures = Pictures(env, render_mode)
        self.single_observation_space = space(env.observation_sizes[self._agent])
        self.single_action_space = space(env.action_sizes[self._agent], bound=1.0)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.action_space = batch_space(self.single_action_space, env.num_envs)

    def reset(self, *, seed: int | None = None, options: Values | None = None) -> tuple[ndarray, Values]:
        """Start all episodes; without a seed the random generator goes on. `options` are ignored."""
        super().reset(seed=seed)
        if seed is not None:
            self._env.seed(seed)
        return array(self._env.reset().policy[self._agent]), {}

    def step(self, actions: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray, Values]:
        """Act for one control step; actions are clipped to [-1, 1].

        Infos hold the entries of `outcome` for episodes that ended; their masks begin with an underscore.
        """
        step = self._env.step({self._agent: action_tensor(self._env, actions)})
        ended = array(step.terminated)
        infos: Values = {}
        for name, values in outcome(step).items() if ended.any() else ():
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
        return self._pictures.draw()

    def close_extras(self, **_: Any) -> None:
        """Free simulation and pictures, if `__init__` came to its end."""
        if hasattr(self, "_pictures"):
            self._pictures.close()


class CatchSingleEnv(gymnasium.Env[ndarray, ndarray]):
    """A single robot with one agent; the only row of a `CatchVectorEnv`."""

    metadata: ClassVar[Values] = dict(METADATA)  # pyright: ignore[reportIncompatibleVariableOverride] (Gymnasium's is a mutable class variable, too)

    def __init__(self, env: CatchEnv, render_mode: str | None = None) -> None:
        """Wrap one environment with one agent, such as `pixel2catch.make("single_agent")`."""
        _require_env(env, "it must be 1, or take CatchVectorEnv")
        self._vector, self.render_mode = CatchVectorEnv(env, render_mode), render_mode
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space

    def reset(self, *, seed: int | None = None, options: Values | None = None) -> tuple[ndarray, Values]:
        """Start an episode; without a seed the random generator goes on. `options` are ignored."""
        super().reset(seed=seed)
        return self._vector.reset(seed=seed)[0][0], {}

    def step(self, action: ndarray) -> tuple[ndarray, float, bool, bool, Values]:
        """Act for one control step; the action is clipped to [-1, 1].

        The infos of the last step of an episode hold `is_tracked`, `is_success` and `episode_steps`.
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


class CatchParallelEnv:
    """A single robot behind PettingZoo's parallel API; its agents act at the same time.

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
        """Wrap one environment, such as `pixel2catch.make("proposed")`."""
        _require_env(env, "it must be 1 for PettingZoo")
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
        """
        if not self.agents:
            return {}, {}, {}, {}, {}
        require(Mapping, "actions", actions)
        step = self._env.step({name: action_tensor(self._env, [each]) for name, each in actions.items()})
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

    def _known(self, agent: str) -> str:
        if agent not in self.possible_agents:
            raise UnknownNameError("agent", agent, self.possible_agents)
        return agent

    def _observe(self, observation: Observation) -> Arrays:
        self._state = array(observation.state)[0]
        return {agent: array(value)[0] for agent, value in observation.policy.items()}
