"""A run keeps the files of its robot and its camera, and does not go on with others."""

import dataclasses
from pathlib import Path

import pytest
from reaching import CONTRACT, SMALL, ReachingEnv

from pixel2catch.errors import CheckpointError
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


def test_resuming_needs_the_same_task(tmp_path: Path) -> None:
    wide = dataclasses.replace(CONTRACT, task="wide")
    train(SHORT, ReachingEnv, wide, tmp_path)
    with pytest.raises(CheckpointError, match="for the task 'wide'"):
        train(SHORT, ReachingEnv, CONTRACT, tmp_path, resume=True)
    assert train(SHORT, ReachingEnv, wide, tmp_path, resume=True).transitions == 1024
