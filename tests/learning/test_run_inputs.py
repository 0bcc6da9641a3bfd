"""A run keeps the files of its robot and its camera, and does not go on with others."""

import dataclasses
import json
from pathlib import Path

import pytest
from reaching import CONTRACT, SMALL, ReachingEnv

from pixel2catch.errors import CheckpointError
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.train import train

SHORT = dataclasses.replace(SMALL, transitions=1024)
NAMES = tuple(SHORT.inputs)


def written(path: Path, content: str = '{"latency": 0.012}') -> Path:
    path.write_text(content)
    return path


def given(name: str, file: Path | None, **changes: int) -> TrainCfg:
    return dataclasses.replace(SHORT, **{name: file}, **changes)


def test_the_inputs_are_options_of_the_training() -> None:
    assert NAMES == ("dynamics", "camera")


@pytest.mark.parametrize("name", NAMES)
def test_run_keeps_its_inputs(name: str, tmp_path: Path) -> None:
    run, file = tmp_path / "run", written(tmp_path / "measured.json")
    train(given(name, file), ReachingEnv, CONTRACT, run)
    kept = {each: (run / f"{each}.json").exists() for each in NAMES}
    assert kept == {each: each == name for each in NAMES}
    assert (run / f"{name}.json").read_bytes() == file.read_bytes()
    assert json.loads((run / "config.json").read_text())["train"][name] == str(file)


@pytest.mark.parametrize("name", NAMES)
def test_resuming_needs_the_same_inputs(name: str, tmp_path: Path) -> None:
    run, file = tmp_path / "run", written(tmp_path / "measured.json")
    train(given(name, file), ReachingEnv, CONTRACT, run)
    for other in (None, written(tmp_path / "other.json", "{}")):
        with pytest.raises(
            CheckpointError, match=f"another {name} file; train with --{name} .*/run/{name}.json"
        ):
            train(given(name, other), ReachingEnv, CONTRACT, run, resume=True)
    assert (run / f"{name}.json").read_bytes() == file.read_bytes()
    for same in (file, run / f"{name}.json"):
        longer = given(name, same, transitions=2048)
        assert train(longer, ReachingEnv, CONTRACT, run, resume=True).transitions == 2048


@pytest.mark.parametrize("name", NAMES)
def test_resuming_without_inputs_takes_none(name: str, tmp_path: Path) -> None:
    train(SHORT, ReachingEnv, CONTRACT, tmp_path)
    with pytest.raises(CheckpointError, match=f"no {name} file; train without --{name}"):
        train(given(name, written(tmp_path / "measured.json")), ReachingEnv, CONTRACT, tmp_path, resume=True)


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_that_name_is_not_overwritten(name: str, tmp_path: Path) -> None:
    """Such as in the folder that an identification or a calibration wrote."""
    mine = written(tmp_path / f"{name}.json", "mine")
    with pytest.raises(CheckpointError, match="name another folder"):
        train(given(name, written(tmp_path / "measured.json")), ReachingEnv, CONTRACT, tmp_path)
    assert mine.read_text() == "mine"


def test_resuming_needs_the_same_task(tmp_path: Path) -> None:
    wide = dataclasses.replace(CONTRACT, task="wide")
    train(SHORT, ReachingEnv, wide, tmp_path)
    with pytest.raises(CheckpointError, match="for the task 'wide'; train with --task wide"):
        train(SHORT, ReachingEnv, CONTRACT, tmp_path, resume=True)
    assert train(SHORT, ReachingEnv, wide, tmp_path, resume=True).transitions == 1024
