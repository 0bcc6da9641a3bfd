"""A reward term of your own: the faster a held object still moves, the more it costs.

python examples/own_reward.py
pixel2catch --import examples/own_reward.py train gentle    # the same, with all options of the command
"""

from dataclasses import replace
from pathlib import Path

import torch
import tyro

import pixel2catch as p2c
from pixel2catch.agents import ARM_REWARD, REWARDS


def held_speed(transition, part):
    """Speed of an object that the palm has caught [m/s], (num_envs,)."""
    speed = torch.linalg.vector_norm(transition.now.object_lin_vel, dim=-1)
    return torch.where(transition.held_steps > 0, speed, 0.0)


term = p2c.RewardTerm(function=held_speed, weight=-0.05)
agents = p2c.agents_of(p2c.find_workcell("ur5e_allegro"), REWARDS | {"arm": (*ARM_REWARD, term)})
gentle = replace(p2c.find_method("proposed"), name="gentle", agents=agents)


def main(out: Path = Path("runs/gentle"), transitions: int = 1_000_000, num_envs: int = 256) -> None:
    """Train with it, then look at its curve, reward_term/arm.held_speed, in metrics.csv."""
    result = p2c.train(gentle, out, transitions=transitions, num_envs=num_envs)
    print(f"arm.held_speed: {result.metrics['reward_term/arm.held_speed']:.4f}")


if __name__ == "__main__":
    tyro.cli(main)
