"""The compiled scene: masses, contacts, sensors, export. All its numbers are those of tests/frozen."""

import mujoco
import numpy as np
import pytest
import torch

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.methods import METHODS
from pixel2catch.scene.scene import SceneCfg, build_model, export
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

FINGERS = ("index", "middle", "ring", "thumb")
HOME = np.array([joint.home for joint in UR5E_ALLEGRO.joints])


def found(model: mujoco.MjModel, data: mujoco.MjData) -> set[str]:
    """Names of the sensors that report a contact."""
    names = [model.sensor(i).name for i in range(model.nsensor)]
    return {name for name in names if data.sensor(name).data[0] > 0}


def test_sensors_name_what_is_touched():
    model = build_model(SceneCfg(), "sphere_s")
    for where, expected in (
        ("palm", {"object_palm", "object_any"}),
        *((f"{finger}_tip", {f"object_{finger}", "object_any"}) for finger in FINGERS),
    ):
        data = mujoco.MjData(model)
        data.qpos[:19] = HOME
        mujoco.mj_kinematics(model, data)
        outwards = data.site("palm").xmat.reshape(3, 3)[:, 0]
        if where != "palm":
            outwards = data.site(where).xpos - data.body(where.replace("tip", "link_3")).xpos
        outwards = outwards / np.linalg.norm(outwards)
        data.qpos[19:22] = data.site(where).xpos + (0.034 if where == "palm" else 0.046) * outwards
        mujoco.mj_forward(model, data)
        assert found(model, data) == expected, where
        assert data.sensor("object_any").data[1] < 0.0
    data = mujoco.MjData(model)
    data.qpos[:19] = HOME
    data.qpos[19:22] = (-0.2, 0.2, 0.81 + 0.034)
    mujoco.mj_forward(model, data)
    assert found(model, data) == {"object_any"}


def test_visuals_change_no_physics():
    plain, seen = build_model(SceneCfg()), build_model(SceneCfg(visuals=True))
    np.testing.assert_allclose(seen.body_mass, plain.body_mass)
    np.testing.assert_allclose(seen.body_inertia, plain.body_inertia)
    assert sum(seen.geom_contype > 0) == sum(plain.geom_contype > 0)
    states = []
    for model in (plain, seen):
        data = mujoco.MjData(model)
        data.qpos[:19] = data.ctrl[:] = HOME
        data.qpos[19:22] = (0.45, 0.13, 1.5)
        mujoco.mj_step(model, data, 60)
        states.append(data.qpos.copy())
    np.testing.assert_allclose(states[1], states[0], atol=1e-9)


@pytest.mark.parametrize("suffix", ["xml", "mjb"])
def test_exported_model_reloads(tmp_path, suffix):
    path = tmp_path / f"scene.{suffix}"
    cfg = SceneCfg(workcell="ur5e_allegro_right", visuals=True)
    export(path, cfg, "l_block")
    expected = build_model(cfg, "l_block")
    load = mujoco.MjModel.from_xml_path if suffix == "xml" else mujoco.MjModel.from_binary_path
    model = load(str(path))
    for field in ("body_mass", "body_inertia", "body_pos", "geom_pos", "geom_size", "jnt_range"):
        values, known = getattr(model, field), getattr(expected, field)
        digits = 1e-5 if suffix == "xml" else 0.0
        np.testing.assert_allclose(values, known, rtol=digits, atol=digits, err_msg=field)
    assert [model.sensor(i).name for i in range(model.nsensor)] == [
        expected.sensor(i).name for i in range(expected.nsensor)
    ]
    assert model.opt.integrator == expected.opt.integrator


TABLE_SPOT = np.array((-0.25, 0.2, 0.81))
PALM_SPOT = np.array((0.44, 0.1333, 1.3915))
PALM_NORMAL = np.array((0.20791, 0.0, 0.97815))


def restitution_of_a_drop(
    model: mujoco.MjModel, spot: np.ndarray, normal: np.ndarray, height: float
) -> float:
    """Normal speed after over before the first impact of a sphere."""
    data = mujoco.MjData(model)
    data.qpos[:19] = data.ctrl[:] = HOME
    data.qpos[19:22] = spot + np.array((0.0, 0.0, 0.04 + height))
    lowest, highest = 0.0, 0.0
    for _ in range(int(0.37 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        speed = data.qvel[19:22] @ normal
        if speed < lowest:
            lowest, highest = speed, 0.0
        highest = max(highest, speed)
    return highest / -lowest


@pytest.mark.parametrize(
    ("restitution", "on", "rate", "cone"),
    [
        *((restitution, "table", 120, "elliptic") for restitution in (0.0, 0.1, 0.3, 0.5)),
        *((0.3, "palm", *other) for other in ((120, "elliptic"), (240, "elliptic"), (120, "pyramidal"))),
    ],
)
def test_drops_bounce_with_the_given_restitution(restitution, on, rate, cone):
    """Mean over the phase of the impact within a step; at 0 the push-out of deep hits adds about 0.1."""
    model = build_model(SceneCfg(physics_hz=rate, cone=cone, object_restitution=restitution), "sphere_l")
    spot, normal = (TABLE_SPOT, np.array((0.0, 0, 1))) if on == "table" else (PALM_SPOT, PALM_NORMAL)
    heights = 0.4 + np.arange(12) / 12 * 2.8 / rate
    mean = np.mean([restitution_of_a_drop(model, spot, normal, height) for height in heights])
    assert mean == pytest.approx(restitution, abs=0.13 if restitution == 0.0 else 0.05)


def test_contacts_can_be_drawn_softer():
    """Each episode its own; the restitution that is asked for stays in the law of the damping."""
    task = CatchEnvCfg(randomization=RandomizationCfg(push_out=(0.1, 0.3), restitution=(0.25, 0.25)))
    env = CatchEnv(task, METHODS["proposed"], num_envs=8, device="cpu", seed=0)
    env.reset()
    solref = env.world.simulation.expand("geom_solref")[:, env.world.objects.indices.geoms]
    dt = task.scene.physics_dt
    shares = -solref[:, 0, 0] * dt**2
    assert ((shares > 0.1) & (shares < 0.3)).all()
    assert shares.std() > 0.02
    torch.testing.assert_close(-solref[:, 0, 1] * dt, 1.25 - 0.5 * shares, rtol=1e-5, atol=0.0)
    env.close()
