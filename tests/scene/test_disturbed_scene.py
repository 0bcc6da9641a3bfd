"""Objects of another size, and what air does to them."""

import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import SceneCfg, build_model, object_table


@pytest.mark.parametrize("name", ["cube_s", "l_block"])
@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_scaled_object_is_larger_but_as_heavy(name: str, factor: float):
    """Lengths by the factor, inertia by its square, mass not."""
    plain, scaled = build_model(SceneCfg(), name), build_model(SceneCfg(object_scale=factor), name)
    body = plain.body("object").id
    assert scaled.body_mass[body] == plain.body_mass[body]
    np.testing.assert_allclose(scaled.body_inertia[body], factor**2 * plain.body_inertia[body])
    geoms = [plain.geom(f"object_part_{i}").id for i in range(len(OBJECTS[name].parts))]
    np.testing.assert_allclose(scaled.geom_rbound[geoms], factor * plain.geom_rbound[geoms], rtol=1e-5)


def test_the_robot_does_not_grow_with_the_object():
    plain, scaled = build_model(SceneCfg()), build_model(SceneCfg(object_scale=1.2))
    object_id = plain.body("object").id
    others = plain.geom_bodyid != object_id
    np.testing.assert_array_equal(scaled.geom_size[others], plain.geom_size[others])


@pytest.mark.parametrize("factor", [0.0, -1.0, 1.5])
def test_a_size_without_room_is_refused(factor: float):
    with pytest.raises(InvalidValueError, match="object_scale"):
        build_model(SceneCfg(object_scale=factor))


def test_the_table_of_objects_has_the_size():
    plain, scaled = object_table(SceneCfg()), object_table(SceneCfg(object_scale=0.8))
    np.testing.assert_allclose(scaled.fields["body_inertia"], 0.64 * plain.fields["body_inertia"])


def test_drag_area_of_a_cube_and_of_a_ball():
    """Three faces of 5 cm, a quarter each; the ball's box has edges of sqrt(2.4) r."""
    assert OBJECTS["cube_s"].drag_area == pytest.approx(0.75 * 0.05**2)
    assert OBJECTS["sphere_s"].drag_area == pytest.approx(0.75 * 2.4 * 0.035**2, rel=0.03)
    assert OBJECTS["cube_s"].scaled(1.2).drag_area == pytest.approx(1.44 * 0.75 * 0.05**2)
