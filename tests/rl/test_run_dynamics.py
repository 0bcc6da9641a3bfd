"""A run keeps the dynamics file of its robot, and does not go on with another robot."""

import dataclasses
import json
from pathlib import Path

import pytest
from reaching import CONTRACT, SMALL, ReachingEnv

from pixel2catch.errors import CheckpointError
from pixel2catch.rl import TrainCfg, train

SHORT = dataclasses.replace(SMALL, transitions=1024)


@pytest.fixture
def identified(tmp_path: Path) -> TrainCfg:
    file = tmp_path / "identified.json"
    file.write_text('{"latency": 0.012}')
    return dataclasses.replace(SHORT, dynamics=file)


def test_run_keeps_its_dynamics(identified: TrainCfg, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(identified, ReachingEnv, CONTRACT, run)
    assert (run / "dynamics.json").read_text() == '{"latency": 0.012}'
    assert json.loads((run / "config.json").read_text())["train"]["dynamics"] == str(identified.dynamics)
    train(SHORT, ReachingEnv, CONTRACT, tmp_path / "nominal")
    assert not (tmp_path / "nominal/dynamics.json").exists()


def test_resuming_needs_the_same_dynamics(identified: TrainCfg, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(identified, ReachingEnv, CONTRACT, run)
    other = tmp_path / "other.json"
    other.write_text('{"latency": 0.1}')
    for dynamics in (None, other):
        with pytest.raises(
            CheckpointError, match=r"other dynamics; train with --dynamics .*/run/dynamics.json"
        ):
            train(dataclasses.replace(SHORT, dynamics=dynamics), ReachingEnv, CONTRACT, run, resume=True)
    assert (run / "dynamics.json").read_text() == '{"latency": 0.012}'
    for dynamics in (identified.dynamics, run / "dynamics.json"):
        longer = dataclasses.replace(SHORT, transitions=2048, dynamics=dynamics)
        assert train(longer, ReachingEnv, CONTRACT, run, resume=True).transitions == 2048
    train(SHORT, ReachingEnv, CONTRACT, tmp_path / "nominal")
    with pytest.raises(CheckpointError, match="train without --dynamics"):
        train(identified, ReachingEnv, CONTRACT, tmp_path / "nominal", resume=True)


def test_a_file_of_that_name_is_not_overwritten(identified: TrainCfg, tmp_path: Path) -> None:
    """Such as in the folder that an identification wrote."""
    (tmp_path / "dynamics.json").write_text("mine")
    with pytest.raises(CheckpointError, match="name another folder"):
        train(identified, ReachingEnv, CONTRACT, tmp_path)
    assert (tmp_path / "dynamics.json").read_text() == "mine"
