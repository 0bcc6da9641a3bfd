"""Trainings that go on from a policy: what they take over, and that they do not throw it away."""

import dataclasses
from functools import partial
from pathlib import Path

import pytest
import torch
from reaching import CONTRACT, SMALL, ReachingEnv, roll_out

from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.mappo import Mappo
from pixel2catch.learning.train import train
from pixel2catch.policy import Policy

NUM_ROLLOUTS = 8
RATE = 1e-3


def starting(policy: Path, **changes: object) -> TrainCfg:
    """A training of eight rollouts, in the first two of which the value networks alone learn."""
    rollout = SMALL.rollout_transitions
    cfg = dataclasses.replace(
        SMALL, start=policy, start_transitions=2 * rollout, transitions=NUM_ROLLOUTS * rollout
    )
    rates = {"schedule": "linear", "learning_rate": RATE, "final_learning_rate": RATE}
    return dataclasses.replace(cfg, **(rates | changes))


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """A policy whose inputs are not standardised by 0 and 1."""
    torch.manual_seed(1)
    networks = Policy(CONTRACT, SMALL.hidden)
    for agent in CONTRACT.agents:
        networks.network(agent).input_mean.fill_(0.25)
        networks.network(agent).input_std.fill_(2.0)
    networks.save(tmp_path / "run" / "policy")
    return tmp_path / "run"


def test_a_learner_gives_back_the_policy_that_it_adopted(policy: Path) -> None:
    mappo = Mappo(SMALL, ReachingEnv(SMALL), CONTRACT)
    adopted = Policy.load(policy / "policy")
    mappo.adopt(adopted)
    for name, tensor in mappo.export().state_dict().items():
        torch.testing.assert_close(tensor, adopted.state_dict()[name])


def parameters(mappo: Mappo, part: str) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for nets in mappo.networks.values() for p in nets.parts[part]])


def test_the_policy_rests_and_begins_gently(policy: Path) -> None:
    """No weight of a policy moves in the first two updates, those of the value networks do.

    At the third the learning rate is 0, at the fourth half of what it becomes: Adam moves a weight by no more
    than the rate in a first step, and hardly more in the next ones.
    """
    cfg = starting(policy)
    env = ReachingEnv(cfg)
    mappo = Mappo(cfg, env, CONTRACT)
    mappo.adopt(Policy.load(policy / "policy"))
    moved = []
    for number in range(5):
        before, known = parameters(mappo, "policy"), parameters(mappo, "value")
        roll_out(mappo, env)
        mappo.update(number / NUM_ROLLOUTS)
        moved.append((parameters(mappo, "policy") - before).abs().max().item())
        assert number == 2 or (parameters(mappo, "value") != known).any()
    num_steps = cfg.epochs * cfg.mini_batches
    assert moved[:3] == [0.0, 0.0, 0.0]
    assert 0.0 < moved[3] <= 1.5 * num_steps * 0.5 * RATE
    assert moved[3] < moved[4] <= 1.5 * num_steps * RATE


def test_a_training_goes_on_from_a_run_and_is_resumed(policy: Path, tmp_path: Path) -> None:
    cfg = starting(policy)
    half = dataclasses.replace(cfg, transitions=cfg.transitions // 2)
    make_env = partial(ReachingEnv)
    train(half, make_env, CONTRACT, tmp_path / "out")
    result = train(cfg, make_env, CONTRACT, tmp_path / "out", resume=True)
    assert result.status == "finished"
    assert result.transitions == cfg.transitions


def test_what_does_not_fit_is_refused(policy: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"--hidden"):
        Mappo(dataclasses.replace(SMALL, hidden=(8,)), ReachingEnv(SMALL), CONTRACT).adopt(
            Policy.load(policy / "policy")
        )
    other = dataclasses.replace(CONTRACT, method="other")
    with pytest.raises(PolicyMismatchError, match="method"):
        train(starting(policy), partial(ReachingEnv), other, tmp_path / "out")
    with pytest.raises(InvalidValueError, match="start_transitions"):
        starting(policy, start_transitions=0)
