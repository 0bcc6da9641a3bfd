"""The inputs of a run: files of robot and camera that it keeps, and the stages of its physics."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from reaching import CONTRACT, SMALL, ReachingEnv

from pixel2catch.errors import CheckpointError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.train import train

SHORT = dataclasses.replace(SMALL, transitions=1024)


def written(path: Path, content: str = '{"latency": 0.012}') -> Path:
    path.write_text(content)
    return path


def test_a_run_keeps_its_inputs_and_goes_on_with_no_others(tmp_path: Path) -> None:
    run, file = tmp_path / "run", written(tmp_path / "measured.json")
    train(SHORT, ReachingEnv, CONTRACT, run, inputs={"dynamics": file, "camera": None})
    assert (run / "dynamics.json").read_bytes() == file.read_bytes()
    assert not (run / "camera.json").exists()
    for bad in ({"dynamics": written(tmp_path / "other.json", "{}")}, {"camera": file}):
        with pytest.raises(CheckpointError, match=f"leave out --{next(iter(bad))}"):
            train(SHORT, ReachingEnv, CONTRACT, run, resume=True, inputs=bad)
    for number, same in enumerate((None, file, run / "dynamics.json"), start=2):
        longer = dataclasses.replace(SHORT, transitions=1024 * number)
        train(longer, ReachingEnv, CONTRACT, run, resume=True, inputs={"dynamics": same})
        assert (run / "dynamics.json").read_bytes() == file.read_bytes()


def test_a_file_of_that_name_is_not_overwritten(tmp_path: Path) -> None:
    """Such as in the folder that an identification wrote."""
    mine = written(tmp_path / "dynamics.json", "mine")
    inputs = {"dynamics": written(tmp_path / "measured.json")}
    with pytest.raises(CheckpointError, match="name another folder"):
        train(SHORT, ReachingEnv, CONTRACT, tmp_path, inputs=inputs)
    assert mine.read_text() == "mine"


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
