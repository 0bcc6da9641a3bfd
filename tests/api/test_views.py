"""Environments made from Python, and Gymnasium's views of them."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import pixel2catch as p2c
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.mdp.terminations import EpisodeCfg

SHORT = CatchEnvCfg(episode=EpisodeCfg(max_steps=6))


def test_nothing_is_loaded_before_it_is_used():
    code = "import sys, pixel2catch; print({'torch', 'mujoco', 'numpy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_every_name_is_there():
    assert all(getattr(p2c, name) is not None for name in p2c.__all__)
    assert set(p2c.__all__) <= set(dir(p2c))
    with pytest.raises(AttributeError, match="no attribute 'mak'"):
        _ = p2c.mak  # pyright: ignore[reportAttributeAccessIssue] (that is the point)


def test_environments_are_made_by_name():
    env = p2c.make("catch+boxes3", num_envs=2, objects=["real_cube", "cross"], seed=1)
    actions = {name: torch.zeros(2, size) for name, size in env.action_sizes.items()}
    assert env.step(actions).rewards["arm"].shape == (2,)
    assert {env.world.objects.names[row] for row in env.episode.parameters.object_id} <= {
        "real_cube",
        "cross",
    }
    with pytest.raises(InvalidValueError, match="an action of agent 'arm' is NaN"):
        env.step(actions | {"arm": torch.full((2, 6), float("nan"))})
    env.step(actions)
    env.check()
    env.close()
    with pytest.raises(UnknownNameError, match="Did you mean 'proposed'"):
        p2c.make("propose")


@pytest.mark.filterwarnings("ignore:.*WARN:UserWarning")
def test_gymnasium_accepts_a_single_robot(opengl: None):
    """Spaces, seeds, determinism of steps, pictures: what Gymnasium's own check looks at."""
    check_env(p2c.CatchSingleEnv(p2c.make("single_agent", task=SHORT), render_mode="rgb_array"))


def test_a_vector_of_robots_goes_on_after_the_end():
    env = RecordEpisodeStatistics(p2c.CatchVectorEnv(p2c.make("single_agent", num_envs=3, task=SHORT)))
    observations, _ = env.reset(seed=5)
    assert env.observation_space.contains(observations)
    again, _ = env.reset(seed=5)
    assert np.array_equal(observations, again)
    for number in range(1, 13):
        observations, rewards, terminated, truncated, infos = env.step(np.zeros((3, 19), np.float32))
        assert observations.shape == env.observation_space.shape
        assert (rewards.shape, truncated.any()) == ((3,), False)
        assert terminated.all() == (number % 6 == 0)
        if number % 6 == 0:
            assert infos["episode_steps"].tolist() == infos["episode"]["l"].tolist() == [6, 6, 6]
            assert infos["_is_success"].all()
            assert not infos["is_success"].any()
    env.close()


def test_a_view_needs_what_its_library_knows():
    several = p2c.make("proposed", num_envs=2, task=SHORT)
    with pytest.raises(InvalidValueError, match=r"agents arm, hand; Gymnasium has one: make 'single_agent'"):
        p2c.CatchVectorEnv(several)
    with pytest.raises(InvalidValueError, match="must be 1 for PettingZoo"):
        p2c.CatchParallelEnv(several)
    with pytest.raises(InvalidValueError, match="must be 1, or take CatchVectorEnv"):
        p2c.CatchSingleEnv(several)
    several.close()
    with pytest.raises(UnknownNameError, match="unknown render mode 'human'"):
        p2c.CatchVectorEnv(p2c.make("single_agent", task=SHORT), render_mode="human")


def test_a_picture_shows_the_robot_and_what_is_thrown(opengl: None):
    env = p2c.CatchParallelEnv(p2c.make("proposed", objects="cube_s"), render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    for _ in range(20):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    second = env.render()
    env.close()
    assert first is not None
    assert second is not None
    assert (first.shape, first.dtype, first.shape) == ((480, 640, 3), np.uint8, second.shape)
    assert (first != second).any()
