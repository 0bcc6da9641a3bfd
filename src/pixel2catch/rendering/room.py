"""The scene in a room with a thrower: furnished for camera images, or plain and bright for films."""

from dataclasses import dataclass, replace
from math import exp, pi, sin

import mujoco
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from pixel2catch.robots.workcell import VISUAL_GROUP
from pixel2catch.scene.scene import SceneCfg, build_spec

WALL_X = 4.6  #: Position of the wall behind the thrower [m]; its foot is in the upper half of the image.
TEXTURE_SIZE = 512  #: Side of a texture [px].
GRAINS = ((3.0, 9.0), (24.0, 16.0))  #: Size [px] and standard deviation [levels] of a texture's patterns.
FLOOR_LEVEL = (128.0, 124.0, 116.0)  #: Mean red, green and blue of the floor [levels].
WALL_LEVEL = (172.0, 168.0, 158.0)  #: Mean red, green and blue of the wall [levels].
NUM_POSTERS = 6

FILM_FLOOR = (0.64, 0.58, 0.50), (0.62, 0.56, 0.48)  #: Both colours of the floor of a film.
#: A point [m] and the normal of each wall of a film; people throw from up to 5 m (`tasks.PEOPLE_THROWS`).
FILM_WALLS = ((5.6, 0.0, 1.6), (-1.0, 0.0, 0.0)), ((0.0, 2.4, 1.6), (0.0, -1.0, 0.0))
FILM_WALL_RGBA = (0.90, 0.91, 0.92, 1.0)

CLOTHES_RGBA = (0.16, 0.20, 0.32, 1.0)
TROUSERS_RGBA = (0.30, 0.27, 0.22, 1.0)
SKIN_RGBA = (0.80, 0.58, 0.46, 1.0)
BALL_RGBA = (0.85, 0.28, 0.15, 1.0)

SHOULDER = (0.42, 0.12, 0.56)  #: Position of the shoulder relative to the held object [m].
HAND_DROP = 0.085  #: Height of the held object above the middle of the hand [m].
HAND_RADIUS = 0.045
SWAY, SWAY_PERIOD = 0.012, 2.9  #: Amplitude [rad] and period [s] of swaying about the feet. Source: ours.

#: Angle of the arm's swing after a release [rad], and its time constant [s]: it begins with 4 m/s.
FOLLOW_THROUGH, SWING_TIME = 1.0, 0.16
BALL_PIVOT, BALL_LENGTH, BALL_RADIUS = (3.4, -0.75, 2.3), 1.2, 0.05  #: Of a hanging red ball [m].
BALL_SWING, BALL_PERIOD = 0.4, 2.2  #: Amplitude [rad] and period [s] of the ball.

#: Joints of the bystanders, the last in `qpos`.
BYSTANDER_JOINTS = ("thrower_x", "thrower_y", "thrower_z", "thrower_sway", "thrower_arm", "ball_swing")

ONLY_SEEN = {"group": VISUAL_GROUP, "contype": 0, "conaffinity": 0}


@dataclass(frozen=True, kw_only=True)
class Bystanders:
    """Motion of thrower and hanging ball during one throw."""

    release_pos: Float[np.ndarray, "3"]  #: Position of the object before the throw [m].
    phase: float  #: Phase of their swinging at time 0 [rad].
    release: float = 0.0  #: Time of the release [s]; infinite without one.

    def joint_pos(self, time: float) -> Float[np.ndarray, "6"]:
        """Return the positions of `BYSTANDER_JOINTS` [m, rad] at a time [s]."""
        sway = SWAY * sin(2 * pi * time / SWAY_PERIOD + self.phase)
        swing = BALL_SWING * sin(2 * pi * time / BALL_PERIOD + 3.0 * self.phase)
        swung = max(time - self.release, 0.0)
        arm = FOLLOW_THROUGH * (1.0 - exp(-swung / SWING_TIME))
        return np.array((*self.release_pos, sway, arm, swing))


def build_room(scene: SceneCfg, object_name: str, seed: int) -> mujoco.MjModel:
    """Return the compiled scene in a furnished room; the bystanders come last in `qpos`.

    The seed is of textures and posters.
    """
    spec = build_spec(replace(scene, visuals=True), object_name)
    rng = np.random.default_rng(seed)
    spec.texture("floor").builtin = mujoco.mjtBuiltin.mjBUILTIN_NONE
    _paint(spec.texture("floor"), FLOOR_LEVEL, rng)
    _add_wall(spec, rng)
    _add_bystanders(spec)
    return spec.compile()


def build_film_room(scene: SceneCfg, object_name: str) -> mujoco.MjModel:
    """Return the compiled scene in a bright, plain room; `qpos` is as of `build_room`."""
    spec = build_spec(replace(scene, visuals=True), object_name)
    spec.texture("floor").rgb1, spec.texture("floor").rgb2 = FILM_FLOOR
    for pos, normal in FILM_WALLS:
        size, plane = (8, 8, 1), mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(
            type=plane, pos=pos, zaxis=normal, size=size, rgba=FILM_WALL_RGBA, **ONLY_SEEN
        )
    _add_bystanders(spec)
    for geom in spec.body("ball").geoms:
        geom.rgba[3] = 0.0
    _add_light(spec)
    return spec.compile()


def _add_light(spec: mujoco.MjSpec) -> None:
    """Replace the scene's lights by a lamp, the only one with a shadow, and light from all sides."""
    for light in tuple(spec.lights):
        spec.delete(light)
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = (0.5,) * 3, (0.18,) * 3, (0.0,) * 3
    spec.visual.map.shadowclip = 1.6
    spec.stat.center = (0.9, 0.0, 1.0)
    kind, diffuse, specular = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, (0.6,) * 3, (0.3,) * 3
    spec.worldbody.add_light(
        pos=(0.2, -1.6, 3.4), dir=(0.28, 0.5, -1.0), type=kind, diffuse=diffuse, specular=specular
    )


def _paint(texture: mujoco.MjsTexture, level: tuple[float, float, float], rng: np.random.Generator) -> None:
    size = (TEXTURE_SIZE, TEXTURE_SIZE)
    pattern = np.zeros(size)
    for grain, deviation in GRAINS:
        smooth = ndimage.gaussian_filter(rng.normal(size=size), grain, mode="wrap")
        pattern += deviation * smooth / smooth.std()
    pixels = np.clip(pattern[..., None] + level, 0, 255).astype(np.uint8)
    texture.height, texture.width, texture.nchannel = pixels.shape
    texture.data = pixels.tobytes()


def _add_wall(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    texture = spec.add_texture(name="wall", type=mujoco.mjtTexture.mjTEXTURE_2D)
    _paint(texture, WALL_LEVEL, rng)
    material = spec.add_material(name="wall", texrepeat=(1, 1), texuniform=True, specular=0.05, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "wall"
    box, plane = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE
    wall = {"pos": (WALL_X, 0, 1.5), "zaxis": (-1, 0, 0), "size": (1.5, 5, 1), "material": "wall"}
    spec.worldbody.add_geom(type=plane, **wall, **ONLY_SEEN)
    for i in range(NUM_POSTERS):
        y, z = rng.uniform(-2.0, 2.0), rng.uniform(0.2, 1.4)
        half = (0.01, rng.uniform(0.1, 0.35), rng.uniform(0.1, 0.3))
        color = (*rng.uniform(0.1, 0.9, 3), 1.0)
        pos = (WALL_X - 0.02 * (i + 1), y, z)
        spec.worldbody.add_geom(type=box, pos=pos, size=half, rgba=color, **ONLY_SEEN)


def _add_bystanders(spec: mujoco.MjSpec) -> None:
    x, y, _ = SHOULDER
    hand = np.array((0.0, 0.0, -HAND_DROP)) - SHOULDER
    thrower = spec.worldbody.add_body(name="thrower")
    arm = thrower.add_body(name="thrower_arm", pos=SHOULDER)
    ball = spec.worldbody.add_body(name="ball", pos=BALL_PIVOT)
    for axis, name in zip(np.eye(3), BYSTANDER_JOINTS[:3], strict=True):
        thrower.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    hinges = (
        (thrower, (x, y + 0.2, -0.8), (1, 0, 0)),  # about the feet
        (arm, (0, 0, 0), (0, 1, 0)),
        (ball, (0, 0, 0), (1, 0, 0)),
    )
    for (body, pos, axis), name in zip(hinges, BYSTANDER_JOINTS[3:], strict=True):
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, pos=pos, axis=axis)
    for body, start, end, radius, rgba in (
        (thrower, (x, y + 0.09, -0.75), (x, y + 0.09, -0.05), 0.08, TROUSERS_RGBA),
        (thrower, (x, y + 0.31, -0.75), (x, y + 0.31, -0.05), 0.08, TROUSERS_RGBA),
        (thrower, (x, y + 0.2, 0.1), (x, y + 0.2, 0.5), 0.17, CLOTHES_RGBA),
        (thrower, (x, y + 0.2, 0.78), (x, y + 0.2, 0.84), 0.1, SKIN_RGBA),
        (arm, (0, 0, 0), 0.55 * hand, 0.055, CLOTHES_RGBA),
        (arm, 0.55 * hand, hand, 0.04, SKIN_RGBA),
        (arm, hand, 0.97 * hand, HAND_RADIUS, SKIN_RGBA),
        (ball, (0, 0, -BALL_LENGTH), (0, 0, -BALL_LENGTH - 1e-3), BALL_RADIUS, BALL_RGBA),
    ):
        kind, ends = mujoco.mjtGeom.mjGEOM_CAPSULE, (*start, *end)
        body.add_geom(type=kind, fromto=ends, size=(radius, 0, 0), rgba=rgba, **ONLY_SEEN)
