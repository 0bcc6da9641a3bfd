"""A robot of your own: the paper's arm and hand, 10 cm nearer to the thrower.

    pixel2catch train catch_teacher --import examples/own_robot.py --workcell nearer --out runs/nearer
    pixel2catch evaluate runs/nearer --import examples/own_robot.py

Another arm or hand is a folder with its MJCF and its joints: CONTRIBUTING.md, "Add to the package".
"""

from dataclasses import replace

import torch
import tyro

import pixel2catch as p2c

paper = p2c.find_workcell("ur5e_allegro")
(robot,) = paper.robots
x, y, z = robot.pos
nearer = replace(paper, name="nearer", robots=(replace(robot, pos=(x + 0.1, y, z)),))


def main(num_envs: int = 4) -> None:
    """See where its palm is, beside that of the paper's robot."""
    for workcell in (paper, nearer):
        env = p2c.make("proposed", workcell=workcell, num_envs=num_envs)
        step = env.step({name: torch.zeros(num_envs, size) for name, size in env.action_sizes.items()})
        print(workcell.name, [round(value, 2) for value in step.measurement.palm_pos[0, 0].tolist()])
        env.close()


if __name__ == "__main__":
    tyro.cli(main)
