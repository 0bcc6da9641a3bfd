"""Evaluate shipped policies in Python, and under a disturbance of one's own.

python examples/evaluate_policies.py
pixel2catch stress --axes nominal examples/evaluate_policies.py:heavy
"""

from dataclasses import replace

import tyro

import pixel2catch as p2c
from pixel2catch.evaluation.loading import task_of


def ten_times(task):
    """The task with objects of 300 g."""
    return replace(task, randomization=replace(task.randomization, mass_scale=(10.0, 10.0)))


level = p2c.Level(label="300", change=ten_times, source="ours: a full can of 0.3 l")
heavy = p2c.Axis(name="heavy", unit="g", levels=(level,))


def main(num_envs: int = 100, trials: int = 1) -> None:
    """Success rates with their 95 % intervals."""
    for name in ("catch_alone+fit", "proposed-seed0"):
        policy = p2c.load_policy(name)
        nominal = task_of(policy)
        for what, task in (("nominal", nominal), (f"{level.label} {heavy.unit}", level.change(nominal))):
            found = p2c.evaluate(policy, num_envs=num_envs, trials=trials, task=task)
            low, high = found["success_rate_interval"]
            print(f"{name}, {what}: {found['success_rate']:.2f} ({low:.2f} to {high:.2f})")


if __name__ == "__main__":
    tyro.cli(main)
