"""Environments made from Python, and Gymnasium's and PettingZoo's views of them."""

import tomllib
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from pettingzoo.test import parallel_api_test

import pixel2catch as p2c
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.mdp.terminations import EpisodeCfg

SHORT = CatchEnvCfg(episode=EpisodeCfg(max_steps=6))


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
            assert infos["episode_steps"].tolist() == [6, 6, 6]
            if number == 6:  # Gymnasium before 1.4 counts one step too few in later episodes
                assert infos["episode"]["l"].tolist() == [6, 6, 6]
            assert infos["_is_success"].all()
            assert not infos["is_success"].any()
    env.close()


def test_gymnasium_makes_a_registered_environment():
    """Where the package is installed, Gymnasium calls the entry point when it is imported."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))["project"]
    (entry,) = project["entry-points"]["gymnasium.envs"].values()
    EntryPoint("catch", entry, "gymnasium.envs").load()()
    env = gymnasium.make("pixel2catch/Catch-v1", objects="cube_s", task=SHORT)
    assert env.reset(seed=1)[0].shape == env.observation_space.shape
    env.close()
    envs = gymnasium.make_vec("pixel2catch/Catch-v1", num_envs=2, method="catch_alone", task=SHORT)
    assert envs.step(envs.action_space.sample())[1].shape == (2,)
    envs.close()


def test_a_view_refuses_environments_that_do_not_fit():
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


@pytest.fixture(scope="module")
def env() -> Iterator[p2c.CatchParallelEnv]:
    env = p2c.CatchParallelEnv(p2c.make("proposed", task=SHORT, seed=3))
    yield env
    env.close()


def still(env: p2c.CatchParallelEnv) -> dict[str, np.ndarray]:
    return {agent: np.zeros(env.action_space(agent).shape, dtype=np.float32) for agent in env.agents}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_api(env: p2c.CatchParallelEnv, capsys: pytest.CaptureFixture[str]):
    parallel_api_test(env, num_cycles=10)  # pyright: ignore[reportArgumentType] (it checks the API, not the class)
    assert "Passed" in capsys.readouterr().out


def test_an_episode_ends_for_all_agents_at_once(env: p2c.CatchParallelEnv):
    env.reset()
    for number in range(1, 7):
        assert env.agents == ["arm", "hand"]
        _, rewards, terminations, truncations, infos = env.step(still(env))
        assert set(rewards) == {"arm", "hand"}
        assert terminations == dict.fromkeys(("arm", "hand"), number == 6)
        assert truncations == {"arm": False, "hand": False}
        ended = {"is_tracked": False, "is_success": False, "episode_steps": 6}
        assert infos["arm"] == (ended if number == 6 else {})
    assert env.agents == []
    assert env.num_agents == 0
    assert env.step({}) == ({}, {}, {}, {}, {})
    env.reset()
    assert env.agents == ["arm", "hand"]


def test_it_is_the_same_environment():
    """A seed gives the observations, states and rewards that `CatchEnv` gives."""
    batched, single = (
        p2c.make("single_agent", task=SHORT),
        p2c.CatchParallelEnv(p2c.make("single_agent", task=SHORT)),
    )
    batched.seed(7)
    expected, (observations, _) = batched.reset(), single.reset(seed=7)
    for _ in range(5):
        assert observations["robot"].tolist() == expected.policy["robot"][0].tolist()
        assert single.state().tolist() == expected.state[0].tolist()
        action = np.full(19, 0.3, dtype=np.float32)
        observations, rewards, *_ = single.step({"robot": action})
        step = batched.step({"robot": torch.from_numpy(action)[None]})
        expected = step.observation
        assert rewards["robot"] == step.rewards["robot"].item()


def test_wrong_actions_are_named(env: p2c.CatchParallelEnv):
    env.reset()
    with pytest.raises(UnknownNameError, match=r"'leg'.*arm, hand"):
        env.action_space("leg")
    with pytest.raises(InvalidValueError, match=r"agent 'arm' is of shape \(1, 7\); give .* \(1, 6\)"):
        env.step(still(env) | {"arm": np.zeros(7)})
    env.step(still(env))
