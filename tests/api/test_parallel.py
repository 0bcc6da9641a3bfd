"""The catching environment behind PettingZoo's parallel API."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from pettingzoo.test import parallel_api_test

from pixel2catch.api.calls import make
from pixel2catch.api.parallel import CatchParallelEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.mdp.terminations import EpisodeCfg

CFG = CatchEnvCfg(episode=EpisodeCfg(max_steps=6))


@pytest.fixture(scope="module")
def env() -> Iterator[CatchParallelEnv]:
    env = CatchParallelEnv(make("proposed", task=CFG, seed=3))
    yield env
    env.close()


def still(env: CatchParallelEnv) -> dict[str, np.ndarray]:
    return {agent: np.zeros(env.action_space(agent).shape, dtype=np.float32) for agent in env.agents}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_api(env: CatchParallelEnv, capsys: pytest.CaptureFixture[str]):
    parallel_api_test(env, num_cycles=10)  # pyright: ignore[reportArgumentType] (it checks the API, not the class)
    assert "Passed" in capsys.readouterr().out


def test_spaces(env: CatchParallelEnv):
    assert env.possible_agents == ["arm", "hand"]
    sizes = {
        agent: (env.observation_space(agent).shape, env.action_space(agent).shape)
        for agent in ("arm", "hand")
    }
    assert sizes == {"arm": ((50,), (6,)), "hand": ((78,), (13,))}
    with pytest.raises(UnknownNameError, match=r"unknown agent 'leg'.*Valid: arm, hand"):
        env.action_space("leg")


def test_an_episode_ends_for_all_agents_at_once(env: CatchParallelEnv):
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
    batched, single = make("single_agent", task=CFG), CatchParallelEnv(make("single_agent", task=CFG))
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


def test_what_is_handed_out_does_not_change(env: CatchParallelEnv):
    observations, _ = env.reset()
    kept, state = {name: value.copy() for name, value in observations.items()}, env.state()
    copied = state.copy()
    env.step(still(env))
    assert all(np.array_equal(observations[name], value) for name, value in kept.items())
    assert np.array_equal(state, copied)


def test_wrong_actions_are_named(env: CatchParallelEnv):
    env.reset()
    with pytest.raises(InvalidValueError, match="no action for agent 'hand'; each step needs arm, hand"):
        env.step({"arm": np.zeros(6)})
    with pytest.raises(InvalidValueError, match=r"agent 'arm' has shape \(7,\); it must be \(6,\)"):
        env.step(still(env) | {"arm": np.zeros(7)})
    with pytest.raises(InvalidValueError, match="an action of agent 'arm' is NaN"):
        env.step(still(env) | {"arm": np.full(6, np.nan)})
    env.step(still(env))
