"""A training whose physics becomes finer."""

import dataclasses
from pathlib import Path

import pytest
from reaching import CONTRACT, SMALL, ReachingEnv

from pixel2catch.errors import InvalidValueError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.train import train


def test_physics_rates_share_the_training(tmp_path: Path) -> None:
    """Of four rollouts three begin in the first two thirds; at the change the environments are new."""
    made: list[tuple[float, ReachingEnv]] = []

    def make_env(cfg: TrainCfg) -> ReachingEnv:
        made.append((cfg.physics_hz[0], ReachingEnv(cfg)))
        return made[-1][1]

    cfg = dataclasses.replace(SMALL, physics_hz=(120.0, 120.0, 240.0))
    train(cfg, make_env, CONTRACT, tmp_path / "run")
    assert [rate for rate, _ in made] == [120.0, 240.0]
    assert [env.num_steps for _, env in made] == [3 * SMALL.rollout_steps, SMALL.rollout_steps]
    assert all(env.is_closed for _, env in made)
    assert [cfg.rate_at(n) for n in (0, 2730, 2731, 4095, 4096)] == [120.0, 120.0, 240.0, 240.0, 240.0]


@pytest.mark.parametrize("staggered", [True, False])
def test_first_episodes_are_staggered_whenever_environments_are_new(tmp_path: Path, staggered: bool) -> None:
    made: list[ReachingEnv] = []

    def make_env(cfg: TrainCfg) -> ReachingEnv:
        made.append(ReachingEnv(cfg))
        return made[-1]

    cfg = dataclasses.replace(SMALL, physics_hz=(120.0, 240.0), staggered=staggered)
    train(cfg, make_env, CONTRACT, tmp_path)
    assert [env.staggered_resets for env in made] == [[staggered], [staggered]]


def test_a_training_needs_a_rate() -> None:
    with pytest.raises(InvalidValueError, match="physics_hz is empty"):
        dataclasses.replace(SMALL, physics_hz=())


@pytest.mark.parametrize("latency_steps", [(2, 1), (-1, 2)])
def test_a_latency_has_a_range(latency_steps: tuple[int, int]) -> None:
    with pytest.raises(InvalidValueError, match="latency_steps"):
        dataclasses.replace(SMALL, latency_steps=latency_steps)
