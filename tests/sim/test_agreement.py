"""Both back ends move alike, float64 against float32; and what either refuses."""

import math
from collections.abc import Iterator

import copies
import pytest
import torch
import warp as wp
from copies import HOME, NUM_ENVS, NUM_JOINTS

from pixel2catch.errors import NonFiniteError
from pixel2catch.scene.constants import PHYSICS_DT
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.sim import warp
from pixel2catch.sim.batch import BatchSimulation
from pixel2catch.sim.simulation import Simulation

NAMES = ("cube_s", "sphere_l", "l_block", "capsule_l")
CATCH_SPOT = (0.44, 0.1333, 1.3915 + 0.15)


@pytest.fixture(scope="module")
def both() -> list[Simulation]:
    return [copies.make("batch"), copies.make("warp")]


def start(simulation: Simulation) -> None:
    copies.restart(simulation)
    copies.give(simulation, NAMES, (0.5, 0.8, 1.2, 1.5))


def swing(simulation: Simulation, num_steps: int) -> Iterator[torch.Tensor]:
    """Every joint swings by 0.1 rad at 1 Hz; yields the state after each step."""
    for step in range(num_steps):
        angle = 0.1 * math.sin(2 * math.pi * step * PHYSICS_DT)
        simulation.bind("ctrl")[:] = (HOME + angle).to(simulation.dtype)
        simulation.step()
        yield simulation.bind("qpos").double().clone()


def require_equal_catches(both: list[Simulation], num_steps: int, before: float, after: float) -> None:
    """Objects fall 15 cm onto the moving hand; bounds of the errors before and after the impact [m, rad]."""
    paths = []
    for simulation in both:
        start(simulation)
        copies.place(simulation, CATCH_SPOT)
        paths.append(torch.stack(list(swing(simulation, num_steps))))
        simulation.check()
    torch.testing.assert_close(paths[0][:18], paths[1][:18], atol=before, rtol=0)
    joints, pos = slice(0, NUM_JOINTS), slice(NUM_JOINTS, NUM_JOINTS + 3)
    torch.testing.assert_close(paths[0][..., joints], paths[1][..., joints], atol=after / 5, rtol=0)
    torch.testing.assert_close(paths[0][..., pos], paths[1][..., pos], atol=after, rtol=0)


def test_catches_agree(both):
    require_equal_catches(both, 60, before=5e-6, after=5e-3)


def test_touches_agree(both):
    sensors = []
    for simulation in both:
        start(simulation)
        copies.place(simulation, (CATCH_SPOT[0], CATCH_SPOT[1], 1.3915 + 0.015))
        sensors.append(simulation.bind("sensordata").double().clone())
    found = [values[:, 0::2] > 0 for values in sensors]
    assert torch.equal(*found)
    assert found[0].any(dim=-1).all()
    torch.testing.assert_close(sensors[0][:, 1::2], sensors[1][:, 1::2], atol=1e-4, rtol=0)


def test_threads_change_no_bit():
    paths = []
    for num_threads in (1, 2):
        simulation = BatchSimulation(build_model(SceneCfg()), 3, num_threads)
        copies.place(simulation, CATCH_SPOT)
        simulation.bind("ctrl")[:] = HOME
        copies.run(simulation, 40)
        paths.append(simulation.bind("qpos").clone())
    assert torch.equal(*paths)


def test_lost_contacts_are_reported(monkeypatch):
    """With room for one contact in four environments, objects on the table overflow it."""
    monkeypatch.setattr(warp, "CONTACTS_PER_DOF", 0.04)
    simulation = copies.make("warp", NUM_ENVS)
    copies.restart(simulation)
    simulation.check()
    copies.place(simulation, (*copies.ON_TABLE[:2], copies.ON_TABLE[2] + 0.024))
    simulation.step()
    with pytest.raises(NonFiniteError, match="raise CONTACTS_PER_DOF"):
        simulation.check()
    wp.to_torch(vars(simulation)["_data"].overflow)[:] = torch.tensor([1, 9, 9, 1])
    with pytest.raises(NonFiniteError, match=r"\.NEFC\|NARROWPHASE"):
        simulation.check()
