"""Tasks that are mixtures of variants: shares, ranges, and what value networks are told of an episode."""

from dataclasses import replace

import pytest
import torch

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg, TaskVariant
from pixel2catch.envs.episode import Episode, draw_episode
from pixel2catch.envs.tasks import TASKS
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.mdp.randomization import RandomizationCfg, by_joint
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import find_method
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

MANY = 20_000
COARSE = SceneCfg(physics_hz=60.0)
OBJECT_IDS = torch.arange(6)
PLAIN = CatchEnvCfg()
FAR = TaskVariant(
    share=0.3,
    throws=ThrowCfg(release_x=(3.5, 3.6), spin=5.0),
    randomization=RandomizationCfg(mass_scale=(3.0, 4.0), command_delay=(1.0, 2.0), command_delay_grid=0.0),
    sensing=SensingCfg(latency_steps=(3.5, 4.5), latency_grid=0.0, drop_rate=(0.2, 0.4), clock_error=0.02),
)
NEAR = replace(
    FAR, share=0.2, throws=ThrowCfg(release_x=(1.5, 1.6)), sensing=SensingCfg(latency_steps=(5, 6))
)
MIXED = replace(PLAIN, variants=(FAR, NEAR))

BIAS = by_joint(UR5E_ALLEGRO, "action_bias", torch.device("cpu"))


def draw(cfg: CatchEnvCfg, num_envs: int = MANY) -> Episode:
    return draw_episode(
        cfg.for_workcell(UR5E_ALLEGRO), BIAS, OBJECT_IDS, num_envs, torch.Generator().manual_seed(0)
    )


@pytest.mark.parametrize("shares", [(0.3, 0.2), (0.7, 0.3)])
def test_shares_are_met(shares: tuple[float, float]):
    """Within four standard errors; they may be everything."""
    task = replace(PLAIN, variants=(replace(FAR, share=shares[0]), replace(NEAR, share=shares[1])))
    x = draw(task).throw.pos[:, 0]
    found = ((x > 3.4).float().mean(), (x < 1.7).float().mean(), ((x > 2.0) & (x < 3.0)).float().mean())
    for part, share in zip(found, (*shares, 1.0 - sum(shares)), strict=True):
        assert part.item() == pytest.approx(share, abs=4 * (share * (1.0 - share) / MANY) ** 0.5 + 1e-6)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_every_variant_keeps_its_own_ranges(number: int):
    """Throw, robot and sight of an episode are of one variant."""
    episode, cfg = draw(MIXED), MIXED.all_variants[number]
    x, sight = episode.throw.pos[:, 0], episode.camera_errors
    assert sight is not None
    is_own = (x >= cfg.throws.release_x[0]) & (x <= cfg.throws.release_x[1])
    assert is_own.any()
    drop_rate, grid = cfg.sensing.drop_rate, cfg.sensing.latency_grid
    expected = {
        "mass": (episode.parameters.mass_scale, cfg.randomization.mass_scale),
        "latency": (episode.parameters.latency, cfg.sensing.latency_steps),
        "delay": (episode.command_delay, cfg.randomization.command_delay),
        "drops": (sight.drop_rate, drop_rate if isinstance(drop_rate, tuple) else (drop_rate,) * 2),
        "spin": (episode.throw.ang_vel.norm(dim=-1), (0.0, cfg.throws.spin)),
    }
    for name, (values, limits) in expected.items():
        found, slack = values[is_own], 1e-5 + 0.02 * (limits[1] - limits[0])
        assert limits[0] - 1e-5 <= found.min() <= limits[0] + slack, name
        assert limits[1] - slack <= found.max() <= limits[1] + 1e-5, name
    clock_error = (0.02 if number == 1 else 0.0) / CONTROL_DT
    own_error = sight.clock_error[is_own].abs()
    torch.testing.assert_close(own_error, torch.full_like(own_error, clock_error))
    assert (len(episode.parameters.latency[is_own].unique()) == 2) == bool(grid)


def test_impossible_variants_are_refused():
    with pytest.raises(InvalidValueError, match=r"\[0.7, 0.4\]; their sum must not exceed 1"):
        replace(PLAIN, variants=(replace(FAR, share=0.7), replace(NEAR, share=0.4)))
    with pytest.raises(InvalidValueError, match=r"sensing\.corner_noise"):
        replace(PLAIN, variants=(replace(FAR, sensing=replace(FAR.sensing, corner_noise=4.0)),))


def test_episodes_that_are_of_no_variant_are_those_of_the_task_alone():
    cfg = TASKS["wide"]
    plain, mixed = draw(PLAIN, 200), draw(cfg, 200)
    same = ((plain.throw.lin_vel - mixed.throw.lin_vel).abs() < 1e-4).all(dim=-1)  # air of no density rounds
    rest = 1.0 - sum(variant.share for variant in cfg.variants)
    assert same.float().mean().item() == pytest.approx(rest, abs=4 * (rest * (1.0 - rest) / 200) ** 0.5)
    for name, values in vars(plain.parameters).items():
        assert torch.equal(values[same], getattr(mixed.parameters, name)[same]), name


def test_the_longest_delays_are_those_of_any_variant():
    assert (PLAIN.longest_latency, PLAIN.longest_command_delay) == (2, 0)
    assert (MIXED.longest_latency, MIXED.longest_command_delay) == (6, 2)
    late = replace(PLAIN, randomization=RandomizationCfg(command_delay=(0.0, 1.2)))
    assert late.longest_command_delay == 2
    assert TASKS["wide"].longest_latency == 4


def test_files_of_robot_and_camera_and_hovering_are_those_of_all_variants():
    """And without a file each keeps its own."""
    assert TASKS["wide"].with_files(None, None) == TASKS["wide"]
    camera = CameraFile(camera=replace(RGB_CAMERA, fx=600.0))
    gains = GainRanges(stiffness_scale=((0.99, 1.01),) * 19)
    task = MIXED.with_dynamics(DynamicsFile(gains=gains)).with_camera(camera)
    assert all(each.sensing.camera == camera for each in task.all_variants)
    assert all(each.randomization.gains == gains for each in task.all_variants)
    assert task.scene.camera == camera.camera
    assert all(each.throws.hover_steps == (5, 26) for each in MIXED.with_longer_hovering(7).all_variants)


def test_drawn_parameters_by_hand():
    """Of a nominal episode after 9 steps: mass, restitution, friction, latency, delay, then how far it is."""
    episode = draw(PLAIN, 2)
    hover = torch.tensor([14, 5])
    record = replace(
        episode.record,
        steps=torch.tensor([9, 9]),
        held_steps=torch.tensor([0, 5]),
        rested_steps=torch.tensor([0, 15]),
    )
    later = replace(episode, record=record, throw=replace(episode.throw, hover_steps=hover))
    told = later.drawn_parameters()
    drawn = episode.parameters
    for column, values in enumerate((drawn.mass_scale, drawn.restitution, drawn.friction, drawn.latency)):
        assert torch.equal(told[:, column], values)
    torch.testing.assert_close(told[:, 5:9], torch.tensor([[0.1, 0.0, 0.0, 0.25], [0.1, 0.25, 0.75, 0.0]]))
    assert torch.equal(told[:, -3:], episode.throw.aim)


def test_value_networks_see_the_draws_where_the_task_says_so():
    """State: observations, what is told, 21 numbers of the truth; the same size in every step and episode."""
    method, sizes = find_method("catch+age"), []
    for value_sees_parameters in (False, True):
        cfg = replace(
            MIXED, value_sees_parameters=value_sees_parameters, episode=EpisodeCfg(max_steps=3), scene=COARSE
        )
        env = CatchEnv(cfg, method, num_envs=3, seed=1)
        assert env.observation_sizes == {"arm": 51, "hand": 79}
        for _ in range(4):
            step = env.step({name: torch.zeros(3, size) for name, size in env.action_sizes.items()})
            assert step.observation.state.shape == (3, env.state_size)
            assert step.observation.state.isfinite().all()
            told = env.episode.drawn_parameters() if value_sees_parameters else torch.zeros(3, 0)
            assert torch.equal(step.observation.state[:, 130:-21], told)
        sizes.append(env.state_size)
    assert sizes == [51 + 79 + 21, 51 + 79 + 21 + 70 + 4]
