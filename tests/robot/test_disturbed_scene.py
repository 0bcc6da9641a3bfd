"""Objects of another size, and air."""

from math import cosh, log, sqrt, tanh

import mujoco
import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError
from pixel2catch.robot.object_table import object_table
from pixel2catch.robot.objects import OBJECTS
from pixel2catch.robot.scene import SceneCfg, build_model
from pixel2catch.sim.batch import BatchSimulation
from pixel2catch.sim.warp import WarpSimulation

AIR = 1.2
"""[kg/m³]"""


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
        SceneCfg(object_scale=factor)


def test_the_table_of_objects_has_the_size():
    plain, scaled = object_table(SceneCfg()), object_table(SceneCfg(object_scale=0.8))
    np.testing.assert_allclose(scaled.fields["body_inertia"], 0.64 * plain.fields["body_inertia"])


def fallen(density: float, mass: float, duration: float) -> tuple[float, float]:
    """Height lost [m] and speed [m/s] of a cube of 5 cm that falls flat from far above everything."""
    model = build_model(SceneCfg(air_density=density, physics_hz=1200.0))
    body = model.body("object").id
    model.body_mass[body] = mass
    model.body_inertia[body] = mass * 0.05**2 / 6
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)  # what MuJoCo derives from masses
    start = model.joint("object_joint").qposadr[0]
    data.qpos[start + 2] = 100.0
    for _ in range(round(duration * 1200)):
        mujoco.mj_step(model, data)
    velocity = model.joint("object_joint").dofadr[0]
    return 100.0 - data.qpos[start + 2], -data.qvel[velocity + 2]


@pytest.mark.parametrize("mass", [0.03, 0.015])
def test_drag_of_a_falling_cube(mass: float):
    """m dv/dt = m g - rho A v² / 2 with A the face: v = v_end tanh(g t / v_end)."""
    end = sqrt(2 * mass * 9.81 / (AIR * 0.05**2))
    distance, speed = fallen(AIR, mass, 1.0)
    assert speed == pytest.approx(end * tanh(9.81 / end), rel=2e-3)
    assert distance == pytest.approx(end**2 / 9.81 * log(cosh(9.81 / end)), rel=3e-3)
    assert speed < 9.81 - 0.5


def test_drag_area_of_a_cube_and_of_a_ball():
    """Three faces of 5 cm, a quarter each; the ball's box has edges of sqrt(2.4) r."""
    assert OBJECTS["cube_s"].drag_area == pytest.approx(0.75 * 0.05**2)
    assert OBJECTS["sphere_s"].drag_area == pytest.approx(0.75 * 2.4 * 0.035**2, rel=0.03)
    assert OBJECTS["cube_s"].scaled(1.2).drag_area == pytest.approx(1.44 * 0.75 * 0.05**2)


def test_without_air_nothing_slows_a_fall():
    distance, speed = fallen(0.0, 0.03, 1.0)
    assert speed == pytest.approx(9.81, rel=1e-6)
    assert distance == pytest.approx(9.81 / 2, rel=2e-3)


def test_both_back_ends_have_the_same_air():
    model, speeds = build_model(SceneCfg(air_density=AIR)), []
    height, dofs = model.joint("object_joint").qposadr[0] + 2, model.joint("object_joint").dofadr[0]
    for simulation in (BatchSimulation(model, 2), WarpSimulation(model, 2, "cpu")):
        simulation.bind("qpos")[:, height] = 50.0
        simulation.forward()
        for _ in range(30):
            simulation.step()
        speeds.append(simulation.bind("qvel")[:, dofs + 2].double().clone())
    np.testing.assert_allclose(speeds[1].numpy(), speeds[0].numpy(), rtol=1e-5)
    assert (speeds[0] > -9.81 * 30 / 120 + 0.005).all()
