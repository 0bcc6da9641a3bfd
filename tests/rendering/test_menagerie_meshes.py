"""Meshes of a checkout of the MuJoCo Menagerie, which a small one of our own stands for."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from pixel2catch.cli.main import main
from pixel2catch.errors import InvalidValueError
from pixel2catch.methods import PROPOSED
from pixel2catch.policy import Policy, contract_of
from pixel2catch.rendering.meshes import require_meshes
from pixel2catch.rendering.room import build_film_room
from pixel2catch.robots.workcell import VISUAL_GROUP
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.workcells import find_workcell

BLUE = (0.0, 0.0, 1.0, 1.0)
CORNER = "v 0 0 0\nv 0.01 0 0\nv 0 0.01 0\nv 0 0 0.01\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
GEOM = '<geom type="mesh" mesh="{mesh}" group="2" contype="0" conaffinity="0" material="blue"/>'
MODEL = """<mujoco><compiler angle="radian" meshdir="assets"/>
<asset><material name="blue" rgba="0 0 1 1"/><mesh name="{mesh}" file="{mesh}.obj"/></asset>
<worldbody>{bodies}</worldbody></mujoco>"""
ARM = """<body name="base" quat="0 0 0 -1">
  <body name="shoulder_link" pos="0 0 0.163"><joint axis="0 0 1"/>
    <body name="upper_arm_link" pos="0 0.138 0" quat="1 0 1 0"><joint axis="0 1 0"/>{geom}</body>
  </body></body>"""
HAND = """<body name="palm" quat="0 1 0 1"><body name="mf_base" pos="0 0 0.0007">{geom}</body></body>"""


@pytest.fixture
def menagerie(tmp_path: Path) -> Path:
    for name, mesh, bodies in (
        ("universal_robots_ur5e/ur5e.xml", "tube", ARM),
        ("wonik_allegro/left_hand.xml", "block", HAND),
    ):
        path = tmp_path / name
        (path.parent / "assets").mkdir(parents=True)
        (path.parent / "assets" / f"{mesh}.obj").write_text(CORNER)
        path.write_text(MODEL.format(mesh=mesh, bodies=bodies.format(geom=GEOM.format(mesh=mesh))))
    return tmp_path


def corner(model: mujoco.MjModel, data: mujoco.MjData, body: str) -> np.ndarray:
    """Where the origin of the blue mesh of a body is in the world."""
    is_blue = (model.geom_rgba == BLUE).all(axis=1)
    geom = int(np.flatnonzero(is_blue & (model.geom_bodyid == model.body(body).id))[0])
    mesh = model.geom_dataid[geom]
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, model.mesh_pos[mesh], _inverse(model.mesh_quat[mesh]))
    return data.geom_xpos[geom] - data.geom_xmat[geom].reshape(3, 3) @ turned


def _inverse(quat: np.ndarray) -> np.ndarray:
    inverse = np.zeros(4)
    mujoco.mju_negQuat(inverse, quat)
    return inverse


def test_meshes_are_where_the_robots_bodies_are(menagerie: Path):
    """With all joints at 0 the shoulder is 13.8 cm beside the axis and 16.3 cm above the base."""
    model = build_film_room(SceneCfg(), "cube_s", menagerie)
    data = mujoco.MjData(model)
    data.qpos[:19] = 0.0
    mujoco.mj_kinematics(model, data)
    base, palm = (data.body(name) for name in ("base_link", "palm"))
    expected = base.xpos + base.xmat.reshape(3, 3) @ (0.0, 0.138, 0.163)
    np.testing.assert_allclose(corner(model, data, "upper_arm_link"), expected, atol=1e-6)
    expected = palm.xpos + palm.xmat.reshape(3, 3) @ (0.0, 0.0, 0.095 + 0.0007)
    np.testing.assert_allclose(corner(model, data, "middle_link_0"), expected, atol=1e-6)


def test_only_what_is_seen_changes(menagerie: Path):
    own, dressed = (build_film_room(SceneCfg(), "cube_s", folder) for folder in (None, menagerie))
    for model in (own, dressed):
        assert not model.geom_contype[model.geom_group == VISUAL_GROUP].any()
    for field in ("body_mass", "body_inertia", "body_ipos", "jnt_axis", "body_pos", "body_quat"):
        np.testing.assert_array_equal(getattr(own, field), getattr(dressed, field))
    blue = (dressed.geom_rgba == BLUE).all(axis=1)
    assert [dressed.body(i).name for i in dressed.geom_bodyid[blue]] == ["upper_arm_link", "middle_link_0"]


def test_a_folder_without_them(tmp_path: Path):
    with pytest.raises(InvalidValueError, match=r"lacks universal_robots_ur5e/ur5e\.xml"):
        require_meshes(find_workcell("ur5e_allegro"), tmp_path)


def test_a_model_that_cannot_be_read(menagerie: Path):
    (menagerie / "universal_robots_ur5e" / "ur5e.xml").write_text("<mujoco>")
    with pytest.raises(InvalidValueError, match="cannot read the meshes of"):
        build_film_room(SceneCfg(), "cube_s", menagerie)


def test_the_command_draws_stills_with_meshes(menagerie: Path, opengl: None):
    Policy(contract_of(PROPOSED), hidden=(16,)).save(menagerie / "policy")
    path, options = (
        menagerie / "stills.png",
        ["--throws", "1", "--view", "outside", "--meshes", str(menagerie)],
    )
    assert main(["play", str(menagerie / "policy"), "--out", str(path), *options]) == 0
    with Image.open(path) as image:
        assert image.size == (6 * 320, 180)
