"""Makers' models in place of ours: copies of ours in other words, and what is not the robot."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from maker_difference import differences, reach

from pixel2catch.cli.fields import TaskOptions
from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError
from pixel2catch.robots.allegro import allegro
from pixel2catch.robots.maker import maker_parts
from pixel2catch.robots.ur5e import UR5E
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells import find_workcell

WORKCELL = find_workcell("ur5e_allegro")


def in_other_words(mjcf: Path, path: Path) -> None:
    """Our model without its names, mirrored axes, limbs in reverse order, on a root that is elsewhere."""
    tree = ET.parse(mjcf)
    model = tree.getroot()
    world, pairs = (next(model.iter(name)) for name in ("worldbody", "contact"))
    model.remove(pairs)
    (root,) = list(world)
    world.remove(root)
    carrier = ET.SubElement(world, "body", pos="0.3 -0.2 0.5", euler="0.7 -1.1 2.0")
    carrier.append(root)
    for body in model.iter("body"):
        body.attrib.pop("name", None)
        limbs = [child for child in body if child.tag == "body"]
        for limb in limbs:
            body.remove(limb)
        body.extend(reversed(limbs))
    for geom in model.iter("geom"):
        geom.attrib.pop("name", None)
    for joint in model.iter("joint"):
        axis = np.array(joint.get("axis", "0 0 1").split(), dtype=float)
        joint.attrib = {"axis": " ".join(map(str, -axis)), "pos": " ".join(map(str, 0.05 * axis))}
    tree.write(path)


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    in_other_words(UR5E.mjcf, tmp_path / "arm.xml")
    return tmp_path / "arm.xml"


@pytest.fixture
def hand(tmp_path: Path) -> Path:
    in_other_words(allegro("left").mjcf, tmp_path / "hand.xml")
    return tmp_path / "hand.xml"


def placed(cfg: SceneCfg, joint_pos: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = build_model(cfg)
    data = mujoco.MjData(model)
    data.qpos[: len(joint_pos)] = joint_pos
    mujoco.mj_forward(model, data)
    return model, data


def test_the_same_robot_in_other_words_is_the_same_robot(arm: Path, hand: Path):
    """Fingers are told apart by where they are; whichever way an axis points, our joints turn as ours do."""
    files = (str(hand), str(arm))
    pos = np.array([joint.home for joint in WORKCELL.joints])
    pos += np.random.default_rng(1).uniform(0.0, 0.2, len(pos))
    (ours, own), (theirs, other) = (placed(SceneCfg(robot_model=each), pos) for each in ((), files))
    assert other.site_xpos == pytest.approx(own.site_xpos, abs=1e-6)
    for name in ("upper_arm_link", "thumb_link_0", "index_link_0", "ring_link_3"):
        ids = ours.body(name).id, theirs.body(name).id
        assert theirs.body_mass[ids[1]] == pytest.approx(ours.body_mass[ids[0]])
        assert reach(theirs, ids[1]) == pytest.approx(reach(ours, ids[0]), abs=1e-6)
    whole, bodies = differences(WORKCELL, files, "collision")
    numbers = [float(number) for row in whole for number in re.findall(r"[\d.]+(?= )", row["difference"])]
    assert len(numbers) == 8
    assert max(numbers) <= 0.01  # mm, mrad, N·m, %
    assert len(bodies) == 7 + 17
    assert {row["centre [mm]"] for row in bodies} == {"0.0"}


def test_another_length_moves_the_tool(arm: Path):
    """Of a forearm 2 mm longer: axes 2 mm off at the most, less than half of it on average."""
    tree = ET.parse(arm)
    link = next(body for body in tree.iter("body") if body.get("pos") == "-0.3922 0 0")
    link.set("pos", "-0.3942 0 0")
    tree.write(arm)
    (part,) = maker_parts(WORKCELL, (str(arm),), "collision").values()
    assert 0.0005 < part.distance < 0.002
    pos = np.array([joint.home for joint in WORKCELL.joints])
    (_, own), (_, other) = (placed(SceneCfg(robot_model=each), pos) for each in ((), (str(arm),)))
    moved = np.linalg.norm(other.site("palm").xpos - own.site("palm").xpos)
    assert 0.0005 < moved < 0.003


def test_a_urdf_with_meshes_and_without_masses(tmp_path: Path):
    """A pendulum for an arm is refused by what is wrong; its mesh is found in its package."""
    (tmp_path / "some_description" / "meshes").mkdir(parents=True)
    corners = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "some_description" / "meshes" / "link.obj").write_text(corners)
    (tmp_path / "some_description" / "urdf").mkdir()
    path = tmp_path / "some_description" / "urdf" / "pendulum.urdf"
    shape = '<geometry><mesh filename="package://some_description/meshes/link.{}"/></geometry>'
    path.write_text(
        '<robot name="pendulum"><link name="base"/><link name="rod">'
        f"<visual>{shape.format('dae')}</visual><collision>{shape.format('obj')}</collision></link>"
        '<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    with pytest.raises(
        InvalidValueError, match=r"pendulum\.urdf is no model of a part of 'ur5e_allegro': .*fewer"
    ):
        build_model(SceneCfg(robot_model=(str(path),)))
    path.write_text(path.read_text().replace("link.obj", "lost.obj"))
    with pytest.raises(InvalidValueError, match=r"there is no mesh '.*lost\.obj' in .*urdf or above"):
        build_model(SceneCfg(robot_model=(str(path),)))


def test_the_other_hand_and_a_second_arm_are_refused(tmp_path: Path, arm: Path):
    in_other_words(allegro("right").mjcf, tmp_path / "right.xml")
    with pytest.raises(
        InvalidValueError, match=r"right\.xml is no model.*allegro_left: an axis is off by \d+ mm"
    ):
        build_model(SceneCfg(robot_model=(str(tmp_path / "right.xml"),)))
    with pytest.raises(InvalidValueError, match="is a second model of"):
        build_model(SceneCfg(robot_model=(str(arm), str(arm))))
    plain = tmp_path / "plain.xml"
    plain.write_text('<mujoco><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>')
    with pytest.raises(InvalidValueError, match="has no visual shapes; use its collision shapes"):
        build_model(SceneCfg(robot_model=(str(plain),), robot_surface="visual"))


def test_commands_take_makers_models(
    tmp_path: Path, arm: Path, hand: Path, capsys: pytest.CaptureFixture[str]
):
    files = ["--robot-model", str(arm), str(hand)]
    assert main(["scene", str(tmp_path / "scene.xml"), *files]) == 0
    assert (
        "ur5e_allegro_left: axes differ from the package's model by at most 0.00 mm"
        in capsys.readouterr().out
    )
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")).nu == len(WORKCELL.joints)
    task = TaskOptions(robot_model=(arm, hand)).change(CatchEnvCfg(), "evaluate")
    assert task == replace(CatchEnvCfg(), scene=SceneCfg(robot_model=(str(arm), str(hand))))
    assert main(["play", "--web", *files]) == 2
    assert "leave out --robot-model" in capsys.readouterr().err
    assert main(["evaluate", "--robot-model", str(tmp_path / "none.xml")]) == 2
    assert "none.xml', which is not there" in capsys.readouterr().err
