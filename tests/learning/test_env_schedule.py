"""A training whose physics becomes finer, and whose updates change."""

import dataclasses
from pathlib import Path

import pytest
import torch
from reaching import CONTRACT, SMALL, ReachingEnv

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.log import read_rows
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


EARLY = {"rollout_steps": 32.0, "epochs": 1.0, "mini_batches": 8.0, "ratio_clip": 0.3}


def test_updates_differ_early(tmp_path: Path) -> None:
    """Two of 2,048 transitions and 8 gradient steps begin within the first 2,049, then two of 1,024 and 16.

    Optimisers go on over the change. From there on it can be resumed.
    """
    made: list[ReachingEnv] = []

    def make_env(cfg: TrainCfg) -> ReachingEnv:
        made.append(ReachingEnv(cfg))
        return made[-1]

    cfg = dataclasses.replace(SMALL, early=EARLY, early_transitions=2049, transitions=6144)
    assert (cfg.at(2048).epochs, cfg.at(2048).ratio_clip, cfg.at(2049)) == (1, 0.3, cfg)
    for length, resume in ((4096, False), (6144, True)):
        train(dataclasses.replace(cfg, transitions=length), make_env, CONTRACT, tmp_path, resume=resume)
    train(cfg, make_env, CONTRACT, tmp_path / "whole")
    for folder in (tmp_path, tmp_path / "whole"):
        transitions = [int(row["transitions"]) for row in read_rows(folder / "metrics.csv")]
        assert transitions == [2048, 4096, 5120, 6144]
        agents = torch.load(folder / "checkpoint.pt", weights_only=True)["mappo"]
        steps = agents["arm"]["optimizer"]["state"][0]["step"]
        assert steps == 2 * 8 + 2 * 16
    assert [env.num_steps for env in made] == [64, 32, 96]


@pytest.mark.parametrize(
    ("early", "message"),
    [
        ({"epoch": 2.0}, "early setting 'epoch'.*epochs"),
        ({"epochs": 2.5}, "early epochs is 2.5; it must be a whole number"),
        ({"epochs": float("nan")}, "early epochs is nan"),
        ({"rollout_steps": 0.0}, "rollout_steps is 0"),
        ({"ratio_clip": float("inf")}, "ratio_clip is inf"),
        ({"mini_batches": 7.0}, "cannot be split into 7 equal mini-batches"),
    ],
)
def test_bad_early_settings(early: dict[str, float], message: str) -> None:
    with pytest.raises((InvalidValueError, UnknownNameError), match=message):
        dataclasses.replace(SMALL, early=early)


def test_a_training_needs_a_rate() -> None:
    with pytest.raises(InvalidValueError, match="physics_hz is empty"):
        dataclasses.replace(SMALL, physics_hz=())


@pytest.mark.parametrize("latency_steps", [(2, 1), (-1, 2)])
def test_a_latency_has_a_range(latency_steps: tuple[int, int]) -> None:
    with pytest.raises(InvalidValueError, match="latency_steps"):
        dataclasses.replace(SMALL, latency_steps=latency_steps)
