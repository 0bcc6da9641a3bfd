"""What is only seen of the surroundings: lights, sky, textures; none collides or has mass."""

import mujoco

from pixel2catch.robots.workcell import VISUAL_GROUP, TableSpec

PEDESTAL_RGBA = (0.32, 0.33, 0.35, 1.0)


def add_looks(spec: mujoco.MjSpec, table: TableSpec) -> None:
    """Add everything that is only seen to a complete scene."""
    _add_light(spec)
    _add_textures(spec)
    _add_pedestal(spec, table)


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


def _add_pedestal(spec: mujoco.MjSpec, table: TableSpec) -> None:
    """A block from the floor to the underside of the table."""
    x, y, top = table.center
    height = top - table.thickness
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(x, y, height / 2),
        size=(table.size[0] / 2 - 0.05, table.size[1] / 2 - 0.05, height / 2),
        rgba=PEDESTAL_RGBA,
        group=VISUAL_GROUP,
        contype=0,
        conaffinity=0,
    )
