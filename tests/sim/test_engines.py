"""Other engines against laws and against MuJoCo: what must agree before a policy is judged by them."""

import importlib.util
from dataclasses import replace

import pytest
from engine_calibration import (
    ARM_JOINTS,
    HAND_JOINTS,
    Engine,
    creep,
    flight,
    hop,
    motion,
    physx,
    rebound,
    resting_depth,
    roll,
    slide,
)

from pixel2catch.errors import DeviceUnavailableError, InvalidValueError
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.sim.drake import DrakeCopy
from pixel2catch.sim.factory import ENGINES, make_simulation, require_engine
from pixel2catch.sim.physx import MOST_EXCLUDED, PhysxCopy
from pixel2catch.sim.rigid_world import RigidWorld, rigid_world

PACKAGES = {"physx": "sapien", "drake": "pydrake"}
MISSING = [engine for engine, name in PACKAGES.items() if importlib.util.find_spec(name) is None]
needs_physx = pytest.mark.skipif("physx" in MISSING, reason="SAPIEN is not installed")
needs_drake = pytest.mark.skipif("drake" in MISSING, reason="Drake is not installed")
DRAKE = Engine(name="drake", make_copy=DrakeCopy)
BOTH = [
    pytest.param(physx(), marks=needs_physx, id="physx"),
    pytest.param(DRAKE, marks=needs_drake, id="drake"),
]


@pytest.mark.parametrize("engine", BOTH)
def test_a_free_flight_is_a_parabola_that_keeps_its_spin(engine):
    distance, change = flight(engine, duration=0.3)
    assert distance < 0.05  # mm
    assert change < 0.005


@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize(("joints", "most"), [(ARM_JOINTS, 1.5), (HAND_JOINTS, 3.0)], ids=["arm", "hand"])
def test_joints_move_as_in_mujoco(engine, joints, most):
    """Milliradians of 100; the largest are of a thumb that leans on its limit, which is soft in MuJoCo."""
    assert motion(engine, joints, "sine", duration=0.2) < most


@needs_physx
@pytest.mark.parametrize(("hz", "restitution"), [(600.0, 0.0), (600.0, 0.5), (1200.0, 0.25)])
def test_restitution_is_the_ratio_of_speeds(hz, restitution):
    """A cube at 4 m/s; MuJoCo's own mean is 0.00 to 0.02 over it, but 0.1 at a restitution of 0."""
    mean, deviation = rebound(physx(hz=hz), "cube_l", 4.0, restitution)
    assert mean == pytest.approx(restitution, abs=0.02)
    assert deviation < 0.02


@needs_physx
def test_friction_of_an_impact_is_coulombs():
    """A ball rolls away, a cube that lands flat rises as from a straight impact, at any phase of a step."""
    mean, deviation = roll(physx(hz=600.0), 0.0)
    assert mean == pytest.approx(1.0, abs=0.06)
    assert deviation < 0.06
    mean, deviation = rebound(physx(hz=600.0), "cube_l", 2.0, 0.25, along=2.0)
    assert mean == pytest.approx(0.25, abs=0.03)
    assert deviation < 0.03


@needs_drake
def test_nothing_bounces_in_drake():
    assert rebound(DRAKE, "cube_l", 4.0, 0.0)[0] == pytest.approx(0.0, abs=0.05)
    with pytest.raises(InvalidValueError, match=r"restitution is 0\.25; .* supports 0 only: give --rest"):
        DRAKE.make(restitution=0.25).step()


@pytest.mark.parametrize("engine", BOTH)
def test_friction_is_coulombs(engine):
    """Way of a sliding cube, within 10 %; at rest it stays within 0.4 mm/s."""
    assert slide(engine, 0.5) == pytest.approx(1.0, abs=0.1)
    assert abs(creep(engine)) < 0.4
    assert abs(resting_depth(engine)) < 50.0  # µm
    assert hop(engine, 0.5) < 0.05


@pytest.mark.parametrize("friction", [0.5, 1.0])
def test_what_slides_hops_in_mujoco(friction):
    """A convex contact slips by w and opens by mu w, which brakes by mu² w: both are 0.9 v, what it stops."""
    assert hop(Engine(name="mujoco"), friction) == pytest.approx(0.9 * friction / (1 + friction**2), abs=0.03)


def world() -> RigidWorld:
    model = build_model(SceneCfg())
    model.dof_frictionloss[:] = 0.0
    return rigid_world(model)


@needs_physx
def test_pairs_beyond_the_bits_are_refused():
    crowded = replace(world(), excluded=((4, 6),) * (MOST_EXCLUDED + 1))
    with pytest.raises(InvalidValueError, match=r"33 pairs of bodies are excluded .* at most 32"):
        PhysxCopy(crowded)


@pytest.mark.parametrize("engine", [engine for engine in ENGINES[1:] if engine not in MISSING])
def test_engines_need_the_cpu(engine):
    with pytest.raises(InvalidValueError, match=f"engine '{engine}' does not support CUDA; give --device"):
        make_simulation(build_model(SceneCfg()), 1, "cuda", engine)


@pytest.mark.parametrize("engine", MISSING)
def test_a_missing_engine_says_how_to_install_it(engine):
    message = rf"'{engine}' needs .*, which cannot be imported.*\[{engine}\]"
    with pytest.raises(DeviceUnavailableError, match=message):
        require_engine(engine)
