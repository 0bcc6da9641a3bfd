"""How fast the environment and the physics alone are on this machine."""

import time
from collections.abc import Callable

import torch

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.mdp.terminations import EpisodeCfg

WARM_UP_STEPS = EpisodeCfg().max_steps
"""Control steps before the clock starts; then the environments are at different times of their episodes."""


def control_rate(env: CatchEnv, seconds: float) -> float:
    """Control steps a second, summed over the environments, with random actions.

    Args:
        env: The environments.
        seconds: How long to measure, at least.
    """
    generator = torch.Generator(env.device).manual_seed(0)
    actions = {
        name: 2.0 * torch.rand(env.num_envs, size, generator=generator, device=env.device) - 1.0
        for name, size in env.action_sizes.items()
    }
    env.reset()
    for _ in range(WARM_UP_STEPS):
        env.step(actions)
    return env.num_envs * _rate(lambda: env.step(actions), env, seconds)


def physics_rate(env: CatchEnv, seconds: float) -> float:
    """Physics steps a second, summed over the environments: the simulation alone, from its present state.

    Args:
        env: The environments.
        seconds: How long to measure, at least.
    """
    return env.num_envs * _rate(env.world.simulation.step, env, seconds)


def _rate(call: Callable[[], object], env: CatchEnv, seconds: float) -> float:
    """Calls a second. Reading a number waits for whatever the device has still to do."""
    env.world.joint_pos.sum().item()
    started, calls = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - started) < seconds:
        for _ in range(10):
            call()
        env.world.joint_pos.sum().item()
        calls += 10
    return calls / elapsed
