"""Contact of the object: restitution by drops, and softness."""

import mujoco
import numpy as np
import pytest
import torch

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.methods import METHODS
from pixel2catch.scene.scene import SceneCfg, build_model
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

HOME = np.array([joint.home for joint in UR5E_ALLEGRO.joints])
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
        *(
            (0.3, "palm", rate, cone)
            for rate, cone in ((120, "elliptic"), (240, "elliptic"), (120, "pyramidal"))
        ),
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
