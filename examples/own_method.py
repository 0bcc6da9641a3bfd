"""A method of your own: a single agent that sees the box's size and the age of the image, no centre.

pixel2catch --import examples/own_method.py train size_and_age --out runs/size
pixel2catch evaluate runs/size      # all of its terms are the package's: no file is needed
"""

from dataclasses import replace
from pathlib import Path

import tyro

import pixel2catch as p2c
from pixel2catch.mdp.observations import box_age, joint_pos, palm_pose, pixels

alone = p2c.find_method("single_agent").agents[0]
agent = replace(alone, observation=(pixels, box_age, palm_pose, joint_pos))
size_and_age = p2c.Method(name="size_and_age", agents=(agent,), pixel_features=("w", "h", "dw", "dh"))


def main(out: Path = Path("runs/size"), transitions: int = 1_000_000, num_envs: int = 256) -> None:
    """Train it with networks of your own size."""
    result = p2c.train(size_and_age, out, transitions=transitions, num_envs=num_envs, hidden=(64, 64))
    print(result.status, p2c.load_policy(out).contract.method)


if __name__ == "__main__":
    tyro.cli(main)
