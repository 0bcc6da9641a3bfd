"""The last five boxes as an observation, by a term of your own.

    python examples/last_five_boxes.py
    pixel2catch --import examples/last_five_boxes.py evaluate runs/five_boxes

The package has such a memory, too: `pixel2catch train proposed+boxes5`.
"""

from dataclasses import replace
from pathlib import Path

import torch
import tyro

import pixel2catch as p2c


def last_boxes(frame):
    """Edges [100 px] and ages [control steps] of all remembered boxes, newest first, (num_envs, 25)."""
    boxes = frame.now.boxes
    return torch.cat((boxes.box.flatten(1) / 100.0, boxes.age), dim=-1)


proposed = p2c.find_method("proposed")
agents = tuple(replace(agent, memory=(last_boxes,)) for agent in proposed.agents)
five_boxes = replace(proposed, name="five_boxes", agents=agents, num_boxes=5)


def main(out: Path = Path("runs/five_boxes"), transitions: int = 1_000_000, num_envs: int = 256) -> None:
    """Train with it, and say what the policy observes."""
    result = p2c.train(five_boxes, out, transitions=transitions, num_envs=num_envs)
    print(p2c.Policy.load(result.policy).contract.agents["arm"].observation)


if __name__ == "__main__":
    tyro.cli(main)
