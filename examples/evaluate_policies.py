"""Evaluate a policy in Python, and under a disturbance of your own.

python examples/evaluate_policies.py
pixel2catch --import examples/evaluate_policies.py stress --axes nominal heavy
"""

from dataclasses import replace

import tyro

import pixel2catch as p2c


def ten_times(task):
    """The task with objects of 300 g."""
    return replace(task, randomization=replace(task.randomization, mass_scale=(10.0, 10.0)))


level = p2c.Level(label="300", change=ten_times, source="ours: a full can of 0.3 l")
heavy = p2c.Axis(name="heavy", unit="g", levels=(level,))


def main(policy: str = "proposed", num_envs: int = 100, physics_hz: float = 600.0) -> None:
    """Success rates with their 95 % intervals."""
    for name, change in (("30 g", lambda task: task), ("300 g", level.change)):
        found = p2c.evaluate(policy, num_envs=num_envs, trials=1, physics_hz=physics_hz, change=change)
        low, high = found["success_rate_interval"]
        print(f"{policy}, {name}: {found['success_rate']:.2f} ({low:.2f} to {high:.2f})")


if __name__ == "__main__":
    tyro.cli(main)
