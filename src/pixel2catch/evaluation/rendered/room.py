"""The scene in a room: textured floor and wall, posters, and people and things that move."""

from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import UInt8
from scipy import ndimage

from pixel2catch.evaluation.rendered.bystanders import add_bystanders
from pixel2catch.robot.looks import VISUAL_GROUP
from pixel2catch.robot.scene import SceneCfg, build_spec

WALL_X = 4.6
"""Where the wall behind the thrower is [m]; its foot is in the upper half of the image."""

TEXTURE_SIZE = 512
"""Side of a texture [px]."""

GRAINS = ((3.0, 9.0), (24.0, 16.0))
"""Size [px] and standard deviation [levels] of the patterns that a texture is made of."""

FLOOR_LEVEL = (128.0, 124.0, 116.0)
WALL_LEVEL = (172.0, 168.0, 158.0)
"""Mean red, green and blue of the textures."""

NUM_POSTERS = 6


def build_room(scene: SceneCfg, object_name: str, seed: int) -> mujoco.MjModel:
    """Compile the scene in a room; `qpos` is that of the scene, followed by that of `bystanders`.

    Args:
        scene: The scene of the simulation.
        object_name: What is thrown.
        seed: Of textures and posters; rooms of one seed look alike.
    """
    spec = build_spec(replace(scene, visuals=True), object_name)
    rng = np.random.default_rng(seed)
    floor = spec.texture("floor")
    floor.builtin = mujoco.mjtBuiltin.mjBUILTIN_NONE
    _paint(floor, _texture(FLOOR_LEVEL, rng))
    _add_wall(spec, rng)
    add_bystanders(spec)
    return spec.compile()


def _texture(
    level: tuple[float, float, float], rng: np.random.Generator
) -> UInt8[np.ndarray, "height width 3"]:
    """Grey patterns of several sizes about a mean colour, without seams."""
    size = (TEXTURE_SIZE, TEXTURE_SIZE)
    pattern = np.zeros(size)
    for grain, deviation in GRAINS:
        smooth = ndimage.gaussian_filter(rng.normal(size=size), grain, mode="wrap")
        pattern += deviation * smooth / smooth.std()
    return np.clip(pattern[..., None] + level, 0, 255).astype(np.uint8)


def _paint(texture: mujoco.MjsTexture, pixels: UInt8[np.ndarray, "height width 3"]) -> None:
    """Give a texture these pixels."""
    texture.height, texture.width, texture.nchannel = pixels.shape
    texture.data = pixels.tobytes()


def _add_wall(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    """A wall behind the thrower with posters, some of the object's colour."""
    texture = spec.add_texture(name="wall", type=mujoco.mjtTexture.mjTEXTURE_2D)
    _paint(texture, _texture(WALL_LEVEL, rng))
    material = spec.add_material(name="wall", texrepeat=(1, 1), texuniform=True, specular=0.05, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "wall"
    look = {"group": VISUAL_GROUP, "contype": 0, "conaffinity": 0, "type": mujoco.mjtGeom.mjGEOM_BOX}
    wall = {**look, "type": mujoco.mjtGeom.mjGEOM_PLANE}
    spec.worldbody.add_geom(pos=(WALL_X, 0, 1.5), zaxis=(-1, 0, 0), size=(1.5, 5, 1), material="wall", **wall)
    for i in range(NUM_POSTERS):
        y, z = rng.uniform(-2.0, 2.0), rng.uniform(0.2, 1.4)
        half = (0.01, rng.uniform(0.1, 0.35), rng.uniform(0.1, 0.3))
        color = (*rng.uniform(0.1, 0.9, 3), 1.0)
        spec.worldbody.add_geom(pos=(WALL_X - 0.02 * (i + 1), y, z), size=half, rgba=color, **look)
