"""Thrown objects, of shapes and of mesh files: sizes, inertia, surface points, selection, and their table."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.own_files import add
from pixel2catch.robots.poses import sphere_points
from pixel2catch.scene import shapes
from pixel2catch.scene.meshes import OUTLINE_POINTS, mesh_object
from pixel2catch.scene.objects import OBJECTS, REAL, SEEN, UNSEEN, make_object, select_objects, surface_points
from pixel2catch.scene.scene import SceneCfg, build_model, object_table

SOME = ("sphere_l", "cone_s", "capsule_s", "l_block", "triangular_prism", "box_28")  #: One of each kind.


@pytest.mark.parametrize("name", [*SOME, "cross"])
def test_surface_points_lie_on_the_hull_of_their_part(name):
    spec = OBJECTS[name]
    points = surface_points(spec, 128)
    assert points.shape == (128, 3)
    depths = []
    for part in spec.parts:
        faces = part.faces
        normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        depths.append(np.einsum("fd,pfd->pf", normals, points[:, None] - faces[:, 0]).max(axis=1))
    np.testing.assert_allclose(np.abs(depths).min(axis=0), 0.0, atol=1e-9)
    for part in spec.parts:
        assert (np.abs(points[:, None] - part.vertices).sum(-1).min(axis=0) < 1e-12).all()


def test_selection_by_group_name_and_list():
    assert select_objects("seen") == SEEN
    assert len(SEEN) == 10
    assert len(UNSEEN) == 5
    assert len(REAL) == 3
    assert select_objects("cube_s, real") == ("cube_s", *REAL)
    assert select_objects(["sphere_l", "sphere_l"]) == ("sphere_l",)
    with pytest.raises(UnknownNameError, match="cube_s"):
        select_objects("cube_m")
    with pytest.raises(InvalidValueError):
        select_objects([])


@pytest.mark.parametrize("name", [*SOME, "cross"])
def test_table_rows_turn_one_model_into_another(name):
    cfg = SceneCfg()
    table = object_table(cfg)
    model, expected = build_model(cfg, "cube_s"), build_model(cfg, name)
    for field, values in table.fields.items():
        array = getattr(model, field)
        rows = table.indices.rows(field)
        array[rows] = values[table.names.index(name)].reshape(array[rows].shape)
    model.body_subtreemass[0] = expected.body_subtreemass[0]  # of the whole world, which never moves
    for field in dir(model):
        values = getattr(model, field)
        if isinstance(values, np.ndarray) and field not in ("bvh_nodeid", "cam_poscom0"):
            np.testing.assert_array_equal(values, getattr(expected, field), err_msg=field)


def test_a_scaled_object_is_larger_but_as_heavy():
    """Lengths by the factor, inertia by its square, mass not; the robot keeps its size."""
    plain, scaled = build_model(SceneCfg(), "l_block"), build_model(SceneCfg(object_scale=1.2), "l_block")
    body = plain.body("object").id
    assert scaled.body_mass[body] == plain.body_mass[body]
    np.testing.assert_allclose(scaled.body_inertia[body], 1.44 * plain.body_inertia[body])
    geoms = [plain.geom(f"object_part_{i}").id for i in range(len(OBJECTS["l_block"].parts))]
    np.testing.assert_allclose(scaled.geom_rbound[geoms], 1.2 * plain.geom_rbound[geoms], rtol=1e-5)
    others = plain.geom_bodyid != body
    np.testing.assert_array_equal(scaled.geom_size[others], plain.geom_size[others])
    tables = [object_table(SceneCfg(object_scale=scale)).fields["body_inertia"] for scale in (1.0, 0.8)]
    np.testing.assert_allclose(tables[1], 0.64 * tables[0])


def test_drag_area_of_a_cube_and_of_a_ball():
    """Three faces of 5 cm, a quarter each; the ball's box has edges of sqrt(2.4) r."""
    assert OBJECTS["cube_s"].drag_area == pytest.approx(0.75 * 0.05**2)
    assert OBJECTS["sphere_s"].drag_area == pytest.approx(0.75 * 2.4 * 0.035**2, rel=0.03)
    assert OBJECTS["cube_s"].scaled(1.2).drag_area == pytest.approx(1.44 * 0.75 * 0.05**2)


L_OUTLINE = np.array(((0, 0), (70, 0), (70, 30), (30, 30), (30, 70), (0, 70)))
TOP = np.array(((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)))


def l_mesh(path: Path, depth: float = 50.0) -> Path:
    """The package's `l_block` as a mesh [mm]: an outline of six corners, extruded."""
    mesh = pytest.importorskip("trimesh").creation.extrude_triangulation(L_OUTLINE, TOP, 1.0)
    mesh.apply_scale((1.0, 1.0, depth)).export(path)
    return path


def test_a_mesh_has_the_mass_properties_of_the_same_solid(tmp_path: Path):
    """Of 70 mm legs, 30 mm wide and 50 mm deep, as the catalogue's, and cut into two bars or a few more."""
    block = mesh_object("mesh", l_mesh(tmp_path / "l.obj"), scale=1e-3)
    expected = OBJECTS["l_block"]
    np.testing.assert_allclose(sorted(block.inertia), sorted(expected.inertia), rtol=1e-6)
    assert block.mass == expected.mass
    assert 2 <= len(block.parts) <= 4
    volume = sum(shapes.moments(part.faces)[0, 0] for part in block.parts)
    assert volume == pytest.approx((70 + 40) * 30 * 50 * 1e-9, rel=0.05)


def test_a_fine_mesh_keeps_its_outline_within_a_millimetre(tmp_path: Path):
    pytest.importorskip("trimesh").creation.icosphere(4, radius=0.04).export(tmp_path / "ball.stl")
    (part,) = (ball := mesh_object("ball", tmp_path / "ball.stl")).parts
    assert len(part.vertices) <= OUTLINE_POINTS
    reach = (part.vertices @ sphere_points(500).T).max(axis=0)
    assert np.abs(reach - 0.04).mean() < 2e-3
    assert surface_points(ball, 64).shape == (64, 3)


def test_meshes_that_cannot_be_thrown_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "text.obj").write_text("nothing\n")
    for make, words in (
        (lambda: mesh_object("mesh", tmp_path / "absent.stl"), r"'.*absent\.stl' cannot be read as a mesh"),
        (lambda: mesh_object("mesh", tmp_path / "text.obj"), "cannot be read as a mesh"),
        (lambda: mesh_object("mesh", l_mesh(tmp_path / "flat.obj", depth=0.0)), "has no volume"),
        (lambda: mesh_object("mesh", l_mesh(tmp_path / "l.obj"), scale=0.0), "both must be greater than 0"),
        (lambda: make_object("cube", shapes.box(0.05, 0.05, 0.05), mass=-0.1), r"mass is -0\.1; it must be"),
        (lambda: make_object("nothing"), "has no parts"),
        (lambda: surface_points(OBJECTS["sphere_s"], 10), "at least 64"),
        (lambda: shapes.box(0.05, -0.05, 0.05), r"y is -0\.05; it must be greater than 0"),
    ):
        with pytest.raises(InvalidValueError, match=words):
            make()
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(InvalidValueError, match=r"needs trimesh and CoACD.*\[meshes\]"):
        mesh_object("mesh", l_mesh(tmp_path / "l.obj"))


def test_an_object_of_many_parts_is_in_the_model(monkeypatch: pytest.MonkeyPatch):
    """All models get as many geoms; those that an object does not need hide inside it."""
    bars = [shapes.box(0.02, 0.02, 0.1).moved((0.03 * i, 0.0, 0.0)) for i in range(3)]
    monkeypatch.setitem(OBJECTS, "rake", make_object("rake", *bars, mass=0.06))
    model = build_model(SceneCfg(), "rake")
    assert model.body("object").mass == pytest.approx(0.06)
    places = [model.geom(f"object_part_{i}").pos[0] for i in range(3)]
    assert places == pytest.approx([-0.03, 0, 0.03], abs=1e-9)
    table = object_table(SceneCfg())
    assert table.names[-1] == "rake"
    assert table.fields["geom_dataid"].shape == (len(OBJECTS), 3)
    monkeypatch.setitem(OBJECTS, "world", make_object("world", shapes.box(0.05, 0.05, 0.05)))
    assert object_table(SceneCfg()).names[-1] == "world"  # as MuJoCo calls a body of its own


def test_what_no_body_can_be_is_refused_when_it_is_made():
    """Not when a scene is built with it: there it would also stop throws of other objects."""
    box, cube = shapes.box(0.05, 0.05, 0.08), make_object("cube", shapes.box(0.05, 0.05, 0.05))
    for make, words in (
        (lambda: make_object("rake", shapes.box(0.7, 0.05, 0.05)), "'rake' extends 35 cm"),
        (lambda: make_object("grams", box, mass=50.0), r"2.5e\+05 kg/m³"),
        (lambda: make_object("nothing", box, overlap=box), "no volume"),
        (lambda: make_object("flat", shapes.prism(2, 0.05, 0.05)), "a part has no volume"),
        (lambda: replace(cube, inertia=np.array((1.0, 1.0, 1.0))), "a possible inertia"),
        (lambda: replace(cube, inertia=np.array((1e-5, 1e-5, 1e-4))), "a possible inertia"),
        (lambda: make_object("my bottle", box), "letters, digits"),
        (lambda: add(make_object("seen", box)), "'seen' is in the package"),
    ):
        with pytest.raises(InvalidValueError, match=words):
            make()
