"""What tests of the environment share: exact sensors, and control steps with one action."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg, Step
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import find_method

EXACT = SensingCfg(corner_noise=0.0, joint_noise=0.0, joint_bias=0.0)
AT_ONCE, HOVERING = ThrowCfg(hover_steps=(2, 2)), ThrowCfg(hover_steps=(80, 80))


def make(num_envs: int = 4, seed: int = 0, method: str = "proposed", **changes: Any) -> CatchEnv:
    """Environments whose first draws after construction are those of the seed."""
    env = CatchEnv(replace(CatchEnvCfg(), **changes), find_method(method), num_envs=num_envs)
    env.seed(seed)
    env.reset()
    return env


def rollout(env: CatchEnv, num_steps: int, action: float = 0.0) -> Iterator[Step]:
    for _ in range(num_steps):
        yield env.step({name: torch.full((env.num_envs, n), action) for name, n in env.action_sizes.items()})


def object_pos(env: CatchEnv) -> Tensor:
    return env.world.privileged(env.world.quiet_log()).object_pos


def object_path(env: CatchEnv, num_steps: int) -> Tensor:
    """Positions of the object (num_steps + 1, num_envs, 3) in the robot's frame [m]."""
    return torch.stack([object_pos(env), *(object_pos(env) for _ in rollout(env, num_steps))])


def after(path: Tensor, steps: Tensor) -> Tensor:
    """Positions after these numbers of control steps, between two by linear interpolation."""
    before, rows = steps.long(), torch.arange(len(steps))
    return torch.lerp(path[before, rows], path[before + 1, rows], (steps - before)[:, None])
