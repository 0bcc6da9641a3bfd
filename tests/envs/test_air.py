"""Air that slows objects: a force against the velocity and as its square, whatever an object weighs."""

from dataclasses import replace

import pytest
import torch
from rollouts import AT_ONCE, rollout

from paper_robot import JOINTS
from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.envs.episode import draw_episode
from pixel2catch.mdp.randomization import RandomizationCfg, by_joint
from pixel2catch.methods import METHODS
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

VELOCITY = slice(len(JOINTS), len(JOINTS) + 3)
FINE = SceneCfg(physics_hz=600.0)

BIAS = by_joint(UR5E_ALLEGRO, "action_bias", torch.device("cpu"))


def make(num_envs: int, randomization: RandomizationCfg, scene: SceneCfg = FINE) -> CatchEnv:
    """Environments that throw a small cube in their third step."""
    cfg = CatchEnvCfg(throws=AT_ONCE, objects=("cube_s",), randomization=randomization, scene=scene)
    return CatchEnv(cfg, METHODS["proposed"], num_envs=num_envs, seed=2)


def test_one_physics_step_by_hand():
    """At 5 m/s along (3, 0, 4) and 0.02 /m an object loses 0.5 m/s²; while it hovers, that is all."""
    env = make(3, RandomizationCfg())
    velocity = env.world.simulation.bind("qvel")[:, VELOCITY]
    speeds = torch.tensor([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0], [-6.0, 0.0, -8.0]])
    velocity.copy_(speeds)
    env.world.run(env.world.joint_pos, torch.tensor([0.02, 0.02, 0.01]), num_steps=1)
    slower = torch.tensor([[-0.3, 0.0, -0.4], [0.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    expected = speeds + slower / 600.0
    torch.testing.assert_close(velocity.float(), expected, atol=1e-6, rtol=0)


def test_drag_of_an_episode_is_that_of_its_object_air_and_mass():
    """½ ρ A / m, with the mean area of the object's face and its drawn mass."""
    cfg = CatchEnvCfg(randomization=RandomizationCfg(air_density=1.2))
    names = tuple(OBJECTS)
    generator = torch.Generator().manual_seed(0)
    episode = draw_episode(cfg.for_workcell(UR5E_ALLEGRO), BIAS, torch.arange(len(names)), 50, generator)
    assert episode.drag is not None
    for row, object_id in enumerate(episode.parameters.object_id.tolist()):
        spec = OBJECTS[names[object_id]]
        mass = spec.mass * episode.parameters.mass_scale[row].item()
        assert episode.drag[row].item() == pytest.approx(0.5 * 1.2 * spec.drag_area / mass, rel=1e-5)


def test_air_slows_throws_which_arrive_all_the_same():
    """The thrower makes up for the drag of a light object: within 2 cm at 120 Hz, of about 30 cm."""
    still = RandomizationCfg(mass_scale=(0.5, 0.5))
    env, plain = make(8, replace(still, air_density=1.2), SceneCfg()), make(8, still, SceneCfg())
    assert torch.equal(env.episode.throw.aim, plain.episode.throw.aim)
    speed, aim = env.episode.throw.lin_vel.norm(dim=-1), env.episode.record.aim.clone()
    assert ((speed / plain.episode.throw.lin_vel.norm(dim=-1)) > 1.005).all()
    steps = 2 + plain.episode.throw.flight_time() / CONTROL_DT
    path = [env.world.privileged(env.world.quiet_log()).object_pos]
    path += [env.world.privileged(step.log).object_pos for step in rollout(env, 32)]
    for row in range(8):
        before, share = int(steps[row]), float(steps[row]) % 1.0
        arrival = path[before][row] + share * (path[before + 1][row] - path[before][row])
        assert (arrival - aim[row]).norm() < 0.02
