"""Objects of another size, and what air does to them."""

import numpy as np
import pytest

from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import SceneCfg, build_model, object_table


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
