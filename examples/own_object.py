"""Objects of your own: a bottle of two shapes, and a cup from a mesh file that this script writes.

python examples/own_object.py
pixel2catch --import examples/own_object.py evaluate --objects bottle
pixel2catch --import examples/own_object.py play --objects bottle
"""

import tempfile
from pathlib import Path

import trimesh
import tyro

import pixel2catch as p2c
from pixel2catch.scene import shapes

neck = shapes.prism(8, edge=0.01, height=0.04).moved((0.0, 0.0, 0.07))
bottle = p2c.make_object("bottle", shapes.prism(12, edge=0.016, height=0.1), neck, mass=0.05)


def cup(folder: Path):
    """A cup: a ring and a bottom, written as a mesh in millimetres."""
    ring = trimesh.creation.annulus(r_min=30.0, r_max=35.0, height=60.0, sections=16)
    bottom = trimesh.creation.cylinder(radius=29.9, height=6.0, sections=16)
    bottom.apply_translation((0.0, 0.0, -27.0))
    trimesh.util.concatenate([ring, bottom]).export(folder / "cup.stl")
    return p2c.mesh_object("cup", folder / "cup.stl", scale=0.001, mass=0.04)


def main(num_envs: int = 50, physics_hz: float = 600.0) -> None:
    """Throw both at the shipped policy, which has never seen such things."""
    with tempfile.TemporaryDirectory() as folder:
        objects = [bottle, cup(Path(folder))]
    metrics = p2c.evaluate(objects=objects, num_envs=num_envs, trials=1, physics_hz=physics_hz)
    print({name: each["success_rate"] for name, each in metrics["objects"].items()})


if __name__ == "__main__":
    tyro.cli(main)
