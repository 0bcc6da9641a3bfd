"""`pixel2catch bench`: how fast the simulation is on this machine."""

import json
import os
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure control steps a second of the environment, and physics steps a second of the simulation alone.

    Attributes:
        device: Where to simulate: cpu, cuda, cuda:1, ...
        num_envs: Environments that are simulated side by side.
        seconds: How long each of the two is measured [s].
        json: Print the figures as one JSON object.
    """

    device: str = "cpu"
    num_envs: int = 512
    seconds: float = 5.0
    json: bool = False

    def run(self) -> None:
        """Measure and print."""
        from pixel2catch.cli.device import prepare
        from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
        from pixel2catch.evaluation.speed import control_rate, physics_rate
        from pixel2catch.methods import PROPOSED

        prepare(self.device)
        env = CatchEnv(CatchEnvCfg(), PROPOSED, num_envs=self.num_envs, device=self.device)
        try:
            result = {
                "device": self.device,
                "num_envs": self.num_envs,
                "cpu_cores": os.cpu_count(),
                "control_steps_per_second": control_rate(env, self.seconds),
                "physics_steps_per_second": physics_rate(env, self.seconds),
            }
        finally:
            env.close()
        if self.json:
            print(json.dumps(result, indent=2))
            return
        for name, value in result.items():
            print(f"{name.replace('_', ' ')}: {f'{value:,.0f}' if isinstance(value, float) else value}")
