"""What all back ends promise: one test for `mujoco.batch`, MuJoCo Warp (on its CPU device) and PhysX."""

import importlib.util

import copies
import mujoco
import numpy as np
import pytest
import torch
from copies import BODY, HOME, NUM_ENVS, ON_FLOOR, ON_TABLE, TABLE

from pixel2catch.scene.cfg import contact_solref
from pixel2catch.scene.constants import PHYSICS_DT
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.sim.engine import EngineSimulation
from pixel2catch.sim.simulation import Simulation

GRAVITY = 9.81
DATA_FIELDS = (*copies.STATE, *("time", "xpos", "xquat", "xmat", "site_xpos", "sensordata", "actuator_force"))
ONLY_FIRST = torch.tensor([True, False, False, False])


def engine(name: str, package: str, *marks: pytest.MarkDecorator):
    missing = pytest.mark.skipif(
        importlib.util.find_spec(package) is None, reason=f"{package} is not installed"
    )
    return pytest.param(name, marks=(missing, *marks))


CANNOT = {
    ("drake", "test_a_heavier_object_rests_as_deep"): "its surfaces give way, the more the heavier",
    ("drake", "test_friction_sets_the_way_of_a_sliding_object"): "120 Hz are too few; see test_engines.py",
    ("drake", "test_restitution_sets_the_rebound"): "it has no restitution",
}
"""What other engines do not do, and why."""


@pytest.fixture(
    scope="module",
    params=["batch", "warp", engine("physx", "sapien"), engine("drake", "pydrake", pytest.mark.slow)],
)
def backend(request) -> Simulation:
    return copies.make(request.param)


@pytest.fixture
def simulation(request, backend: Simulation) -> Simulation:
    name = request.node.callspec.params["backend"]
    if reason := CANNOT.get((name, request.node.originalname)):
        pytest.skip(f"{name}: {reason}")
    copies.restart(backend)
    return backend


def test_bound_fields_are_shaped_as_in_mujoco(simulation):
    data = mujoco.MjData(simulation.model)
    for field in DATA_FIELDS:
        bound = simulation.bind(field)
        assert tuple(bound.shape) == (NUM_ENVS, *np.shape(getattr(data, field))), field
        assert bound.dtype == simulation.dtype
        assert bound.data_ptr() == simulation.bind(field).data_ptr()


def test_expanded_fields_are_the_models_in_every_environment(simulation):
    assert not simulation.can_expand("no_such_field")
    for name in copies.changed_fields(simulation):
        assert simulation.can_expand(name)
        expanded, expected = simulation.expand(name), getattr(simulation.model, name)
        assert tuple(expanded.shape) == (NUM_ENVS, *expected.shape), name
        for values in expanded:
            np.testing.assert_allclose(values.numpy(), expected, rtol=1e-6, err_msg=name)


def test_a_write_to_an_expanded_field_stays_in_its_environment(simulation):
    for name in copies.changed_fields(simulation):
        before = simulation.expand(name).clone()
        simulation.expand(name)[1] += 1
        difference = (simulation.expand(name) - before).flatten(1).abs().amax(dim=1)
        assert difference.tolist() == pytest.approx([0, 1, 0, 0], rel=1e-3), name


def test_a_written_state_is_where_the_next_step_starts(simulation):
    qpos, qvel, first = simulation.bind("qpos"), simulation.bind("qvel"), TABLE.indices.qpos.start
    qpos[0, first + 2] = 2.0
    qvel[0, TABLE.indices.dofs.start] = 3.0
    simulation.forward()
    simulation.step()
    fallen = GRAVITY * PHYSICS_DT**2  # semi-implicit: the new velocity moves the object
    expected = torch.tensor([2.0, 1.5, 1.5, 1.5], dtype=torch.float64) - fallen
    torch.testing.assert_close(qpos[:, first + 2].double(), expected, atol=1e-6, rtol=0)
    moved = copies.object_pos(simulation)[:, 0] - 1.5
    torch.testing.assert_close(moved, 3.0 * PHYSICS_DT * ONLY_FIRST.double(), atol=1e-6, rtol=0)


def test_a_written_command_acts_at_the_next_step(simulation):
    simulation.bind("ctrl")[0, 5] += 0.1
    simulation.step()
    turned = simulation.bind("qpos")[:, 5].double() - HOME[5]
    assert turned[0] > 5e-3
    assert turned[1:].abs().max() < 1e-5
    assert simulation.bind("actuator_force")[0, 5] > 1.0


def test_everything_is_current_after_a_step(simulation):
    """Positions and contacts are those of the new state, as after `mj_forward`."""
    copies.push(simulation, (0.0, 1.0, 0.0, 0.0, 0.0, 0.0))
    copies.run(simulation, 3)
    qpos = simulation.bind("qpos")[:, TABLE.indices.qpos][:, :3]
    torch.testing.assert_close(copies.object_pos(simulation), qpos.double(), atol=1e-6, rtol=0)
    found = simulation.model.sensor("object_any").adr[0]
    copies.place(simulation, (0.44, 0.1333, 1.41))  # in the palm
    assert (simulation.bind("sensordata")[:, found] > 0).all()
    copies.place(simulation, copies.IN_THE_AIR)
    assert not simulation.bind("sensordata")[:, found].any()


def test_forward_makes_what_was_written_current_and_leaves_the_rest(simulation):
    before = copies.object_pos(simulation).clone()
    simulation.bind("qpos")[0, TABLE.indices.qpos.start] = 2.5
    simulation.forward(ONLY_FIRST)
    after = copies.object_pos(simulation)
    assert after[0, 0].item() == pytest.approx(2.5)
    assert torch.equal(after[1:], before[1:])


def test_what_touches_goes_on_touching_where_others_are_masked(simulation):
    """Objects in the palm do the same, whether another one is taken out of it or not."""
    found = simulation.model.sensor("object_any").adr[0]
    copies.place(simulation, (0.44, 0.1333, 1.41))
    simulation.forward(ONLY_FIRST)
    simulation.step()
    undisturbed = copies.object_pos(simulation).clone()
    assert (simulation.bind("sensordata")[:, found] > 0).all()  # the masked one is found again
    copies.restart(simulation)
    copies.place(simulation, (0.44, 0.1333, 1.41))
    simulation.bind("qpos")[0, TABLE.indices.qpos] = torch.tensor([*copies.IN_THE_AIR, 1, 0, 0, 0]).to(
        simulation.bind("qpos")
    )
    simulation.forward(ONLY_FIRST)
    simulation.step()
    assert (simulation.bind("sensordata")[:, found] > 0).tolist() == [False, True, True, True]
    torch.testing.assert_close(copies.object_pos(simulation)[1:], undisturbed[1:], atol=1e-6, rtol=0)
    fallen = copies.IN_THE_AIR[2] - GRAVITY * PHYSICS_DT**2  # nothing that it no longer touches holds it
    assert copies.object_pos(simulation)[0, 2].item() == pytest.approx(fallen, abs=1e-5)


def test_different_meshes_rest_at_different_heights(simulation):
    names = ("cube_s", "cylinder_l", "l_block", "cone_l")
    copies.give(simulation, names)
    parts = [OBJECTS[name].parts for name in names]
    expected = -torch.tensor([min(part.vertices[:, 2].min() for part in each) for each in parts]).double()
    spots = torch.tensor(ON_TABLE, dtype=torch.float64).repeat(NUM_ENVS, 1)
    spots[:, 2] += expected + 1e-3
    copies.place(simulation, spots)
    copies.run(simulation, 120)
    height = copies.object_pos(simulation)[:, 2] - ON_TABLE[2]
    torch.testing.assert_close(height, expected, atol=3e-4, rtol=0)
    simulation.check()


def test_force_over_mass_and_torque_over_inertia_are_accelerations(simulation):
    names, scale = ("cube_s", "cube_s", "cube_l", "capsule_l"), (0.5, 1.5, 1.0, 1.25)
    copies.give(simulation, names, scale)
    simulation.bind("xfrc_applied")[:, BODY, 0] = 0.3
    simulation.bind("xfrc_applied")[:, BODY, 5] = 1e-5
    copies.run(simulation, 6)
    rows = [TABLE.names.index(name) for name in names]
    scales, velocity = torch.tensor(scale, dtype=torch.float64), copies.object_vel(simulation)
    inertia = torch.as_tensor(TABLE.fields["body_inertia"][rows, 0, 2]) * scales
    torch.testing.assert_close(velocity[:, 0], 0.3 / (0.03 * scales) * 6 * PHYSICS_DT, rtol=1e-4, atol=0)
    torch.testing.assert_close(velocity[:, 5], 1e-5 / inertia * 6 * PHYSICS_DT, rtol=1e-3, atol=0)


def resting_depth(simulation: Simulation, spot: tuple[float, float, float]) -> torch.Tensor:
    """How deep cubes of half to one and a half times their mass lie in what they rest on [m]."""
    copies.give(simulation, ("cube_s",) * NUM_ENVS, (0.5, 1.0, 1.25, 1.5))
    copies.place(simulation, (*spot[:2], spot[2] + 0.025))
    copies.run(simulation, 60)
    return spot[2] + 0.025 - copies.object_pos(simulation)[:, 2]


@pytest.mark.parametrize("spot", [ON_FLOOR, ON_TABLE], ids=["floor", "table"])
def test_a_heavier_object_rests_as_deep(simulation, spot):
    """Depth does not depend on the mass if what follows the mass was scaled with it, nor on the support."""
    depth = resting_depth(simulation, spot)
    softness = 0.0 if isinstance(simulation, EngineSimulation) else 4.6e-5  # rigid contacts have no depth
    torch.testing.assert_close(depth, torch.full_like(depth, softness), atol=5e-6, rtol=0)


def test_friction_sets_the_way_of_a_sliding_object(simulation):
    """A block at 0.5 m/s stops after v^2 / (2 mu g)."""
    friction = torch.tensor([0.2, 0.3, 0.4, 0.6])
    copies.set_contact(simulation, "geom_friction", friction[:, None])
    copies.place(simulation, (*ON_FLOOR[:2], 0.02495))
    copies.push(simulation, (0.5, 0.0, 0.0, 0.0, 0.0, 0.0))
    copies.run(simulation, 60)
    way = copies.object_pos(simulation)[:, 0] - ON_FLOOR[0]
    torch.testing.assert_close(way, 0.25 / (2 * friction.double() * GRAVITY), rtol=0.15, atol=0)


def test_restitution_sets_the_rebound(simulation):
    copies.give(simulation, ("sphere_l",) * NUM_ENVS)
    restitution = torch.tensor([0.1, 0.2, 0.35, 0.5])
    solref = torch.stack(contact_solref(restitution, PHYSICS_DT), dim=-1)
    copies.set_contact(simulation, "geom_solref", solref)
    copies.place(simulation, (*ON_FLOOR[:2], 0.04 + 0.3))
    speeds = []
    for _ in range(50):
        simulation.step()
        speeds.append(copies.object_vel(simulation)[:, 2].clone())
    before, after = torch.stack(speeds).amin(dim=0), torch.stack(speeds).amax(dim=0)
    rebound = -after / before
    torch.testing.assert_close(rebound, restitution.double(), atol=0.12, rtol=0)
    assert (rebound.diff() > 0.05).all()


def test_gains_set_the_speed_of_a_joint(simulation):
    """A heavily damped servo moves at k / d times the distance of its command."""
    stiffness, damping, distance, joint = 2066.0, 202.0, 0.01, 5
    scale = torch.tensor([[0.8, 1.0], [1.2, 1.0], [1.0, 0.8], [1.0, 1.2]], dtype=torch.float64)
    simulation.expand("actuator_gainprm")[:, joint, 0] = (stiffness * scale[:, 0]).to(simulation.dtype)
    simulation.expand("actuator_biasprm")[:, joint, 1] = (-stiffness * scale[:, 0]).to(simulation.dtype)
    simulation.expand("actuator_biasprm")[:, joint, 2] = (-damping * scale[:, 1]).to(simulation.dtype)
    simulation.bind("ctrl")[:, joint] += distance
    copies.run(simulation, 12)
    turned = simulation.bind("qpos")[:, joint].double() - HOME[joint]
    rate = stiffness / damping * scale[:, 0] / scale[:, 1]
    expected = distance * (1 - torch.exp(-rate * 12 * PHYSICS_DT))
    torch.testing.assert_close(turned, expected, rtol=0.06, atol=0)


def cast(
    simulation: Simulation, direction: tuple[float, float, float], groups: tuple[int, ...]
) -> list[float]:
    """Distances along one ray, from 2 m over the table, in every environment."""
    origin = torch.tensor((*ON_TABLE[:2], ON_TABLE[2] + 2.0), dtype=simulation.dtype)
    directions = torch.tensor(direction, dtype=simulation.dtype).expand(NUM_ENVS, 1, 3)
    return simulation.ray(origin, directions, groups)[:, 0].tolist()


def test_rays_measure_in_units_of_their_direction(simulation):
    assert cast(simulation, (0.0, 0.0, -1.0), (0,)) == pytest.approx([2.0] * NUM_ENVS, rel=1e-6)
    assert cast(simulation, (0.0, 0.0, -4.0), (0,)) == pytest.approx([0.5] * NUM_ENVS, rel=1e-6)
    assert cast(simulation, (0.0, 0.0, 1.0), (0, 1, 3)) == [-1.0] * NUM_ENVS


def test_rays_hit_the_groups_that_were_named(simulation):
    names = ("cube_s", "cube_l", "hexagonal_prism", "cross")
    copies.give(simulation, names)
    copies.place(simulation, (*ON_TABLE[:2], 1.5))
    tops = [max(float(p.vertices[:, 2].max()) for p in OBJECTS[name].parts) for name in names]
    expected = [ON_TABLE[2] + 2.0 - 1.5 - top for top in tops]
    assert cast(simulation, (0.0, 0.0, -1.0), (0, 1, 3)) == pytest.approx(expected, rel=1e-5)
    assert cast(simulation, (0.0, 0.0, -1.0), (0, 3)) == pytest.approx([2.0] * NUM_ENVS, rel=1e-6)
    assert cast(simulation, (0.0, 0.0, -1.0), (3,)) == [-1.0] * NUM_ENVS
