"""`pixel2catch bench`: how fast the simulation is on this machine."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pixel2catch.checks import Count, Device, Positive

if TYPE_CHECKING:
    from pixel2catch.envs.catch_env import CatchEnv


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure control steps a second of the environment, and physics steps a second of the simulation."""

    device: Device = "cpu"  #: Where to simulate: cpu, cuda, cuda:1, ...
    num_envs: Count = 512  #: Environments that are simulated side by side.
    seconds: Positive = 5.0  #: How long each of the two is measured [s].
    json: bool = False  #: Print the figures as one JSON object.

    def run(self) -> None:
        """Measure and print."""
        from pixel2catch.cli.device import prepare
        from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
        from pixel2catch.files import json_text
        from pixel2catch.methods import PROPOSED

        device = prepare(self.device)
        env = CatchEnv(CatchEnvCfg(), PROPOSED, num_envs=self.num_envs, device=device)
        try:
            control = _control_rate(env, self.seconds)
            physics = self.num_envs * _rate(env.world.simulation.step, env, self.seconds)
            result = {
                "device": device,
                "num_envs": self.num_envs,
                "cpu_cores": os.cpu_count(),
                "control_steps_per_second": control,
                "physics_steps_per_second": physics,
            }
        finally:
            env.close()
        if self.json:
            print(json_text(result), end="")
            return
        for name, value in result.items():
            print(f"{name.replace('_', ' ')}: {f'{value:,.0f}' if isinstance(value, float) else value}")


def _control_rate(env: "CatchEnv", seconds: float) -> float:
    """Control steps a second, summed over the environments, with random actions.

    The clock starts when the environments are at different times of their episodes.
    """
    import torch

    from pixel2catch.mdp.terminations import EpisodeCfg

    generator = torch.Generator(env.device).manual_seed(0)
    actions = {
        name: 2.0 * torch.rand(env.num_envs, size, generator=generator, device=env.device) - 1.0
        for name, size in env.action_sizes.items()
    }
    env.reset()
    for _ in range(EpisodeCfg().max_steps):
        env.step(actions)
    return env.num_envs * _rate(lambda: env.step(actions), env, seconds)


def _rate(call: Callable[[], object], env: "CatchEnv", seconds: float) -> float:
    """Calls a second. Reading a number waits for whatever the device has still to do."""
    env.world.joint_pos.sum().item()
    started, calls = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - started) < seconds:
        for _ in range(10):
            call()
        env.world.joint_pos.sum().item()
        calls += 10
    return calls / elapsed
