"""Arrays, spaces and pictures for the views of other libraries."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from jaxtyping import UInt8
from numpy import ndarray
from torch import Tensor

from pixel2catch.envs.catch_env import CatchEnv, Step
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.rendering.film import WIDE
from pixel2catch.rendering.renderer import Renderer
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import build_model

RENDER_MODE = "rgb_array"  #: The only one, besides None for no pictures.
METADATA: Mapping[str, Any] = {
    "name": "pixel2catch",
    "render_modes": [RENDER_MODE],
    "render_fps": round(1.0 / CONTROL_DT),
}


def space(size: int, bound: float = np.inf) -> Box:
    """Return the space of vectors of a size, with entries within a bound."""
    return Box(-bound, bound, (size,), np.float32)


def array(values: Tensor) -> ndarray:
    """Copy values into an array."""
    return values.detach().cpu().numpy().copy()


def action_tensor(env: CatchEnv, agent: str, action: Any) -> Tensor:
    """Return actions (num_envs, num_joints) of an agent as a tensor.

    Raises:
        InvalidValueError: They have another shape.
    """
    values, expected = np.asarray(action, dtype=np.float32), (env.num_envs, env.action_sizes[agent])
    if values.shape != expected:
        shapes = [shape[1:] if env.num_envs == 1 else shape for shape in (values.shape, expected)]
        raise InvalidValueError(f"action of agent '{agent}' has shape {shapes[0]}; it must be {shapes[1]}")
    return torch.tensor(values, device=env.device)


def outcome(step: Step) -> dict[str, ndarray]:
    """Return the results of the episodes, (num_envs,)."""
    record = step.record
    return {
        "is_tracked": array(record.is_tracked),
        "is_success": array(record.is_success),
        "episode_steps": array(record.steps),
    }


class Pictures:
    """Pictures of environments from outside."""

    def __init__(self, env: CatchEnv, render_mode: str | None) -> None:
        """Check the render mode.

        Raises:
            UnknownNameError: There is no such mode.
        """
        if render_mode not in (None, RENDER_MODE):
            raise UnknownNameError("render mode", render_mode, [RENDER_MODE])
        self._env, self._is_drawing = env, render_mode is not None
        self._renderers: dict[str, Renderer] = {}

    def draw(self) -> list[UInt8[ndarray, "height width 3"]] | None:
        """Return a picture of each environment, or None without a render mode.

        Raises:
            DeviceUnavailableError: Nothing can be drawn on this machine.
        """
        if not self._is_drawing:
            return None
        names, ids = self._env.world.objects.names, self._env.episode.parameters.object_id.tolist()
        positions = array(self._env.world.simulation.bind("qpos"))
        return [self._renderer(names[row]).image(qpos) for row, qpos in zip(ids, positions, strict=True)]

    def close(self) -> None:
        """Free the drawing contexts."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _renderer(self, object_name: str) -> Renderer:
        if object_name not in self._renderers:
            scene = replace(self._env.cfg.scene, visuals=True)
            self._renderers[object_name] = Renderer(build_model(scene, object_name), WIDE)
        return self._renderers[object_name]
