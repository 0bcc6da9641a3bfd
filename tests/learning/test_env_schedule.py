"""A training whose physics becomes finer."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from reaching import CONTRACT, SMALL, ReachingEnv

from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.train import train


@pytest.mark.parametrize("staggered", [True, False])
def test_physics_rates_share_the_training(staggered: bool, tmp_path: Path) -> None:
    """Of four rollouts three begin in the first two thirds; at the change the environments are new.

    A resume in the last stage makes only the environments of that stage.
    """
    made: list[Any] = []

    def make_env(cfg: TrainCfg, physics_hz: float | None) -> Any:
        made.append(ReachingEnv(cfg, physics_hz))
        return made[-1]

    cfg = dataclasses.replace(SMALL, physics_stages=(120.0, 120.0, 240.0), staggered=staggered)
    train(cfg, make_env, CONTRACT, tmp_path)
    assert [env.physics_hz for env in made] == [120.0, 240.0]
    assert [env.num_steps for env in made] == [3 * SMALL.rollout_steps, SMALL.rollout_steps]
    assert [env.staggered_resets for env in made] == [[staggered], [staggered]]
    assert [cfg.rate_at(n) for n in (0, 2730, 2731, 4095, 4096)] == [120.0, 120.0, 240.0, 240.0, 240.0]
    longer = dataclasses.replace(cfg, transitions=5120)
    train(longer, make_env, CONTRACT, tmp_path, resume=True)
    assert [env.physics_hz for env in made] == [120.0, 240.0, 240.0]
    assert all(env.is_closed for env in made)
