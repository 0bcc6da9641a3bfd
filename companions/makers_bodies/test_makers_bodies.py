"""Makers' models in place of ours: copies of ours in other words, and what is not the robot."""

import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from runpy import run_path

import mujoco
import numpy as np
import pytest

import pixel2catch as p2c
from makers_bodies import Surface, main, read_model, write_workcell
from pixel2catch.robots.allegro import allegro
from pixel2catch.robots.ur5e import UR5E
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells import workcells

WORKCELL = p2c.find_workcell("ur5e_allegro")
HOME = np.array([joint.home for joint in WORKCELL.joints])


def in_other_words(mjcf: Path, path: Path) -> Path:
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
    return path


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    return in_other_words(UR5E.mjcf, tmp_path / "arm.xml")


def placed(cfg: SceneCfg, joint_pos: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = build_model(cfg)
    data = mujoco.MjData(model)
    data.qpos[: len(joint_pos)] = joint_pos
    mujoco.mj_forward(model, data)
    return model, data


def shapes(model: mujoco.MjModel, data: mujoco.MjData, body: str) -> np.ndarray:
    """Positions and sizes of the colliding shapes of a body, in any order."""
    geoms = (model.geom_bodyid == model.body(body).id) & (model.geom_contype != 0)
    rows = np.hstack((data.geom_xpos[geoms], model.geom_size[geoms]))
    return rows[np.lexsort(rows.round(4).T)]


def test_the_same_robot_in_other_words_is_the_same_robot(
    arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Fingers are found by their place; the sign of a joint is that of our model for any axis."""
    out, hand = tmp_path / "makers", in_other_words(allegro("left").mjcf, tmp_path / "hand.xml")
    monkeypatch.setattr(sys, "argv", ["makers_bodies.py", str(hand), str(arm), "--out", str(out)])
    main()
    lines = capsys.readouterr().out
    assert all(float(number) <= 0.01 for number in re.findall(r"[\d.]+(?= m)", lines))
    assert len(re.findall(r"[\d.]+(?= m)", lines)) == 5
    pos = HOME + np.random.default_rng(1).uniform(0.0, 0.2, len(HOME))
    makers = run_path(str(out / "workcell.py"))["makers"]
    monkeypatch.setitem(workcells(), makers.name, makers)
    (ours, own), (theirs, other) = (
        placed(SceneCfg(workcell=name), pos) for name in ("ur5e_allegro", makers.name)
    )
    assert other.site_xpos == pytest.approx(own.site_xpos, abs=1e-5)
    for name in ("upper_arm_link", "thumb_link_0", "index_link_0", "ring_link_3"):
        assert theirs.body(name).mass == pytest.approx(ours.body(name).mass, rel=1e-5)
        assert theirs.body(name).ipos == pytest.approx(ours.body(name).ipos, abs=1e-5)
        assert shapes(theirs, other, name) == pytest.approx(shapes(ours, own, name), abs=1e-5)


def test_another_length_moves_the_tool(arm: Path, tmp_path: Path):
    """Of a forearm 2 mm longer: axes 2 mm off at the most, less than half of it on average."""
    tree = ET.parse(arm)
    link = next(body for body in tree.iter("body") if body.get("pos") == "-0.3922 0 0")
    link.set("pos", "-0.3942 0 0")
    tree.write(arm)
    axes, tool = write_workcell([arm], tmp_path / "makers")
    assert 0.5 < float(axes.split()[-5]) < 2.0
    assert 0.5 < float(tool.split()[-2]) < 5.0  # the largest of 200 poses


def pendulum(folder: Path) -> str:
    """Write the mesh of a pendulum, 0.1 m large, and return its URDF, whose drawn mesh is unsupported."""
    corners = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (folder / "description" / "meshes").mkdir(parents=True)
    (folder / "description" / "meshes" / "link.OBJ").write_text(corners)
    shape = '<geometry><mesh filename="package://some_description/meshes/{}"/></geometry>'
    return (
        f'<robot name="Gelenk für Würfe"><link name="base"/><link name="rod">'
        f"<visual>{shape.format('link.dae')}</visual><collision>{shape.format('link.OBJ')}</collision></link>"
        '<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/>'
        f'<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>{OWN}{OWN}</robot>'
    )


OWN = '<mujoco><compiler meshdir="description" strippath="true" discardvisual="true"/></mujoco>'


@pytest.mark.parametrize(
    ("name", "declared", "encoding"),
    [
        ("arm.urdf", "UTF-8", "utf-8-sig"),
        ("arm.URDF", "ISO-8859-1", "latin-1"),
        ("a.urdf", "UTF-16", "utf-16"),
    ],
)
def test_a_urdf_is_read_in_its_encoding_with_blocks_of_mujoco(
    name: str, declared: str, encoding: str, tmp_path: Path
):
    text = f'<?xml version="1.0" encoding="{declared}"?>\n{pendulum(tmp_path)}'
    (tmp_path / name).write_text(text, encoding=encoding)
    model = read_model(tmp_path / name, "collision")
    assert (model.njnt, model.ngeom) == (1, 1)
    with pytest.raises(p2c.Pixel2CatchError, match=r"no model of a part of 'ur5e_allegro': .*fewer"):
        write_workcell([tmp_path / name], tmp_path / "makers")


@pytest.mark.parametrize(
    ("old", "new", "surface", "words"),
    [
        ("link.OBJ", "lost.obj", "collision", r"there is no mesh '.*lost\.obj' in .* or above"),
        ("link.OBJ", "link.DAE", "collision", r"collision shape of link 'rod' .*DAE'; convert it to"),
        ("", "", "visual", r"visual shape of link 'rod' is .*link\.dae'; convert"),
        ('OBJ"', 'OBJ" scale="1000 1000 1000"', "collision", r"link 'rod' has a radius of \d+ m; give its"),
        ("<robot", '<?xml version="1.0" encoding="none"?><robot', "collision", "not XML .unknown encoding"),
    ],
)
def test_a_urdf_that_cannot_be_read_is_refused_by_its_part(
    old: str, new: str, surface: Surface, words: str, tmp_path: Path
):
    (tmp_path / "arm.urdf").write_text(pendulum(tmp_path).replace(old, new, 1))
    with pytest.raises(p2c.Pixel2CatchError, match=words):
        read_model(tmp_path / "arm.urdf", surface)


@pytest.mark.parametrize(
    ("names", "surface", "message"),
    [
        (["right"], "collision", r"right\.xml is no model.*allegro_left: an axis is off by \d+ mm"),
        (["arm", "copy"], "collision", "are models of ur5e"),
        (["plain"], "visual", "has no visual shapes; use its other shapes"),
    ],
)
def test_what_is_not_the_robot_is_refused(
    names: list[str], surface: Surface, message: str, tmp_path: Path, arm: Path
):
    in_other_words(allegro("right").mjcf, tmp_path / "right.xml")
    (tmp_path / "copy.xml").write_text(arm.read_text())
    (tmp_path / "plain.xml").write_text(
        '<mujoco><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(p2c.Pixel2CatchError, match=message):
        write_workcell([tmp_path / f"{name}.xml" for name in names], tmp_path / "makers", surface=surface)
    assert not (tmp_path / "makers").exists()


@pytest.mark.parametrize(
    ("name", "content"),
    [("arm.urdf", '<robot name="%n"></robot>'), ("arm.xml", '<mujoco><default class="%n"/></mujoco>')],
)
def test_a_model_with_a_format_character_is_refused(name: str, content: str, tmp_path: Path):
    (tmp_path / name).write_text(content)
    with pytest.raises(p2c.Pixel2CatchError, match="a format of MuJoCo"):
        write_workcell([tmp_path / name], tmp_path / "makers")
