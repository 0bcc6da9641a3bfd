"""What the training loop asks the environment between two updates."""

import csv
from pathlib import Path
from typing import Any

import pytest
from reaching import CONTRACT, SMALL, ReachingEnv

from pixel2catch.errors import NonFiniteError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.train import train


def test_nan_in_a_reward_term_is_named(tmp_path: Path) -> None:
    def make(cfg: TrainCfg, _: float | None) -> Any:
        env = ReachingEnv(cfg)
        env.statistics.time_penalty = float("nan")
        return env

    with pytest.raises(NonFiniteError, match=r"reward term 'arm\.time'"):
        train(SMALL, make, CONTRACT, tmp_path)


def test_the_simulation_is_checked_once_a_rollout(tmp_path: Path) -> None:
    made = []

    def make(cfg: TrainCfg, _: float | None) -> Any:
        made.append(ReachingEnv(cfg))
        return made[-1]

    train(SMALL, make, CONTRACT, tmp_path)
    with (tmp_path / "metrics.csv").open() as file:
        assert made[0].num_checks == len(list(csv.DictReader(file))) > 1
