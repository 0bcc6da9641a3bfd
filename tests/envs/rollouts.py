"""What tests of the environment share: exact sensors, and control steps with one action."""

from collections.abc import Iterator

import torch

from pixel2catch.envs.catch_env import CatchEnv, Step
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.throws import ThrowCfg

EXACT = SensingCfg(corner_noise=0.0, joint_noise=0.0, joint_bias=0.0)
AT_ONCE, HOVERING = ThrowCfg(hover_steps=(2, 2)), ThrowCfg(hover_steps=(80, 80))


def rollout(env: CatchEnv, num_steps: int, action: float = 0.0) -> Iterator[Step]:
    for _ in range(num_steps):
        yield env.step({name: torch.full((env.num_envs, n), action) for name, n in env.action_sizes.items()})
