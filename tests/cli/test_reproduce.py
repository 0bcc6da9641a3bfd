"""Studies through the real command: real trainings and evaluations, as small as they can be."""

import json
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from domains import PATIENCE
from pixel2catch.behaviour import HASHES
from pixel2catch.cli.main import main
from pixel2catch.cli.reproduce import METHODS as STUDY_METHODS
from pixel2catch.evaluation.comparison import EVALUATION_SEED
from pixel2catch.methods import METHODS

TINY = shlex.split(
    "--device cpu --preset cpu --num-envs 2 --trials 1 --methods only_wh --seeds 1 --training num_envs=4 "
    "transitions=320 env.scene.physics_hz=60 rollout_steps=16 hidden=16,8 checkpoint_seconds=0 "
    "env.throws.hover_steps=5,6"
)
RUN = "only_wh-seed0"


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def times(folder: Path) -> dict[str, int]:
    """When each result was written [ns]."""
    files = [*folder.glob("evaluations/*"), *folder.glob("runs/*/summary.json"), folder / "study.json"]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study that was interrupted in its first training and then continued."""
    out = tmp_path_factory.mktemp("study") / "with a, comma"
    command = [sys.executable, "-m", "pixel2catch", "reproduce", *TINY, "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + PATIENCE
    while not (out / "runs" / RUN / "checkpoint.pt").exists():
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert f"{RUN} stopped" in errors
    summary = read(out / "runs" / RUN / "summary.json")
    assert summary["status"] == "interrupted"
    assert 0 < summary["transitions"] < 320
    assert main(["reproduce", *TINY, "--out", str(out)]) == 0
    return out


def test_methods_of_a_study_exist():
    assert set(STUDY_METHODS) <= set(METHODS)


def test_an_interrupted_study_continues(study: Path):
    run = study / "runs" / RUN
    summary = read(run / "summary.json")
    assert (summary["status"], summary["transitions"]) == ("finished", 320)
    assert read(run / "config.json")["env"]["throws"]["hover_steps"] == [5, 6]
    assert len(json.loads((run / "sessions.json").read_text())) == 2
    assert len(read(study / "study.json")["sessions"]) == 2
    result = read(study / "evaluations" / f"{RUN}-unseen.json")
    assert (result["method"], result["trials"], result["physics_hz"]) == ("only_wh", 2, 600.0)
    assert "success rate so far" in (study / "logs" / f"{RUN}-seen.log").read_text()
    rows = read(study / "report" / "table.json")["results"]
    assert [(row["method"], row["objects"], row["trials"]) for row in rows] == [
        ("only_wh", "seen", 2),
        ("only_wh", "unseen", 2),
    ]


def test_only_what_is_missing_is_computed(study: Path):
    """Another machine can evaluate: the device of a finished training is not needed."""
    before = times(study)
    deleted = f"evaluations/{RUN}-unseen.json"
    result = read(study / deleted)
    (study / deleted).unlink()
    assert main(["reproduce", *TINY, "--device", "cuda", "--out", str(study)]) == 0
    after = times(study)
    assert {name for name in after if after[name] != before[name]} == {deleted, "study.json"}
    new = {"seconds": 0, "circumstances": {}}
    assert read(study / deleted) | new == result | new
    assert result["circumstances"]["behaviour"] == HASHES
    assert result["seed"] == EVALUATION_SEED


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
def test_a_missing_device_and_another_configuration_are_refused(
    study: Path, capsys: pytest.CaptureFixture[str]
):
    before, out = times(study), ("--out", str(study))
    assert main(["reproduce", *TINY, *out, "--device", "cuda", "--seeds", "2"]) == 2
    assert "CUDA" in capsys.readouterr().err
    assert main(["reproduce", *TINY, *out, "--trials", "2"]) == 2
    assert "evaluation trials" in capsys.readouterr().err
    assert times(study) == before


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--methods", "propose"), "proposed"),
        (("--training", "seed=4"), "'seed'"),
        (("--training", "num_envs=0"), "num_envs is 0"),
    ],
)
def test_bad_input_leaves_nothing(
    args: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    assert main(["reproduce", "--device", "cpu", "--out", str(out), *args]) == 2
    assert words in capsys.readouterr().err
    assert not list(out.glob("*.json"))
