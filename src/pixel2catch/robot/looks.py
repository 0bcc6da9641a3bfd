"""What is only seen: lights, sky, textures and the parts between the links; none collides or has mass."""

import mujoco

from pixel2catch.robot.constants import TABLE
from pixel2catch.robot.ur5e import FLANGE_RGBA, TUBE_RGBA, Capsule

VISUAL_GROUP = 2
"""Geom group of what is only seen."""

LID_RGBA = (0.15, 0.45, 0.72, 1.0)
PEDESTAL_RGBA = (0.32, 0.33, 0.35, 1.0)

LIDS: dict[str, tuple[Capsule, ...]] = {
    "shoulder_link": (Capsule(start=(0, 0.055, 0.1625), end=(0, 0.066, 0.1625), radius=0.056),),
    "upper_arm_link": (
        Capsule(start=(0, 0, 0.185), end=(0, 0, 0.196), radius=0.053),
        Capsule(start=(-0.425, 0, 0.185), end=(-0.425, 0, 0.196), radius=0.053),
    ),
    "forearm_link": (
        Capsule(start=(0, 0, -0.044), end=(0, 0, -0.034), radius=0.045),
        Capsule(start=(-0.3922, 0, -0.043), end=(-0.3922, 0, -0.034), radius=0.040),
    ),
    "wrist_1_link": (Capsule(start=(0, 0, 0.170), end=(0, 0, 0.179), radius=0.038),),
    "wrist_2_link": (Capsule(start=(0, 0, 0.136), end=(0, 0, 0.145), radius=0.038),),
}
"""Blue lids of the arm's joints."""

HOUSINGS: dict[str, tuple[Capsule, ...]] = {
    "base_link": (Capsule(start=(0, 0, -0.011), end=(0, 0, 0.02), radius=0.075),),
    "upper_arm_link": (
        Capsule(start=(0, 0, 0.04), end=(0, 0, 0.185), radius=0.056),
        Capsule(start=(-0.425, 0, 0.07), end=(-0.425, 0, 0.185), radius=0.056),
    ),
    "forearm_link": (
        Capsule(start=(0, 0, -0.034), end=(0, 0, 0.07), radius=0.048),
        Capsule(start=(-0.3922, 0, -0.034), end=(-0.3922, 0, 0.065), radius=0.044),
    ),
    "wrist_1_link": (Capsule(start=(0, 0, 0.066), end=(0, 0, 0.17), radius=0.0435),),
    "wrist_2_link": (Capsule(start=(0, 0, 0.045), end=(0, 0, 0.136), radius=0.043),),
}
"""Cylinders of the arm's joints."""

FLANGE = Capsule(start=(0, 0, 0.05), end=(0, 0, 0.1070), radius=0.0375)
"""From the last joint to the hand's mount, in `wrist_3_link`."""


def add_looks(spec: mujoco.MjSpec) -> None:
    """Add everything that is only seen to a complete scene."""
    _add_light(spec)
    _add_textures(spec)
    for name, cylinders in LIDS.items():
        _add_cylinders(spec.body(name), cylinders, LID_RGBA)
    for name, cylinders in HOUSINGS.items():
        _add_cylinders(spec.body(name), cylinders, TUBE_RGBA)
    _add_cylinders(spec.body("wrist_3_link"), (FLANGE,), FLANGE_RGBA)
    _add_pedestal(spec)


def _add_light(spec: mujoco.MjSpec) -> None:
    """One light with shadows, a fill light without, and a brighter headlight."""
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = (0.35,) * 3, (0.35,) * 3, (0.1,) * 3
    spec.visual.map.znear = 0.02
    spec.visual.map.shadowclip = 2.0
    spec.stat.extent, spec.stat.center = 2.0, (0.4, 0.0, 1.0)
    for pos, direction, strength, has_shadow in (
        ((1.0, -1.2, 3.6), (-0.25, 0.4, -1.0), 0.55, True),
        ((-1.5, 2.0, 3.0), (0.5, -0.6, -1.0), 0.25, False),
    ):
        spec.worldbody.add_light(
            pos=pos,
            dir=direction,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            diffuse=(strength,) * 3,
            specular=(0.15,) * 3,
            castshadow=has_shadow,
        )


def _add_textures(spec: mujoco.MjSpec) -> None:
    """Sky and a checkered floor."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.62, 0.72, 0.82),
        rgb2=(0.93, 0.95, 0.97),
        width=256,
        height=256,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.50, 0.53, 0.56),
        rgb2=(0.58, 0.61, 0.64),
        width=256,
        height=256,
    )
    material = spec.add_material(name="floor", texrepeat=(1, 1), texuniform=True, specular=0.1, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    floor = spec.geom("floor")
    floor.size, floor.material, floor.rgba = (0, 0, 0.1), "floor", (1, 1, 1, 1)  # size 0: without end
    floor.castshadow = False  # it would speckle itself


def _add_pedestal(spec: mujoco.MjSpec) -> None:
    """A block from the floor to the underside of the table."""
    x, y, top = TABLE.center
    height = top - TABLE.thickness
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(x, y, height / 2),
        size=(TABLE.size[0] / 2 - 0.05, TABLE.size[1] / 2 - 0.05, height / 2),
        rgba=PEDESTAL_RGBA,
        group=VISUAL_GROUP,
        contype=0,
        conaffinity=0,
    )


def _add_cylinders(body: mujoco.MjsBody, cylinders: tuple[Capsule, ...], rgba: tuple[float, ...]) -> None:
    for cylinder in cylinders:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            fromto=(*cylinder.start, *cylinder.end),
            size=(cylinder.radius, 0, 0),
            mass=0.0,
            rgba=rgba,
            group=VISUAL_GROUP,
            contype=0,
            conaffinity=0,
        )
