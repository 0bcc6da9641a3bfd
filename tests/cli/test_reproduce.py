"""Studies through the real command: real trainings and evaluations, as small as they can be."""

import io
import json
import os
import shlex
import signal
import sys
from contextlib import redirect_stderr
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest
import torch

from pixel2catch.behaviour import HASHES
from pixel2catch.cli import studies
from pixel2catch.cli.main import main
from pixel2catch.cli.reproduce import TRAINING
from pixel2catch.cli.train import Train
from pixel2catch.evaluation import grid as grids
from pixel2catch.evaluation.comparison import EVALUATION_SEED
from pixel2catch.evaluation.grid import StudyGrid

FIXED = shlex.split(
    "--preset cpu --num-envs 2 --methods only_wh --training num_envs=4 transitions=320 "
    "env.scene.physics_hz=60 rollout_steps=16 hidden=16,8 checkpoint_seconds=0 env.throws.hover_steps=5,6"
)
RUN = "only_wh-seed0"


def tiny(**given: str) -> list[str]:
    options = {"device": "cpu", "trials": "1", "seeds": "1"} | given
    return [*FIXED, *(word for name, value in options.items() for word in (f"--{name}", value))]


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def times(folder: Path) -> dict[str, int]:
    """When each result was written [ns]."""
    files = [*folder.glob("evaluations/*"), *folder.glob("runs/*/summary.json"), folder / "study.json"]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory, small_study: None) -> Path:
    """A study that was interrupted in its first training and then continued."""
    out = tmp_path_factory.mktemp("study") / "with a, comma"
    errors, has_ended = io.StringIO(), Event()

    def interrupt() -> None:
        while not (out / "runs" / RUN / "checkpoint.pt").exists() and not has_ended.wait(0.01):
            pass
        if not has_ended.is_set():
            os.kill(os.getpid(), signal.SIGINT)

    user = Thread(target=interrupt)
    user.start()
    with redirect_stderr(errors):
        status = main(["reproduce", *tiny(), "--out", str(out)])
    has_ended.set()
    user.join()
    assert status == 130
    assert f"{RUN} stopped" in errors.getvalue()
    summary = read(out / "runs" / RUN / "summary.json")
    assert summary["status"] == "interrupted"
    assert 0 < summary["transitions"] < 320
    assert main(["reproduce", *tiny(), "--out", str(out)]) == 0
    return out


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
    assert main(["reproduce", *tiny(device="cuda"), "--out", str(study)]) == 0
    after = times(study)
    assert {name for name in after if after[name] != before[name]} == {deleted, "study.json"}
    new = {"seconds": 0, "circumstances": {}}
    assert read(study / deleted) | new == result | new
    assert result["circumstances"]["behaviour"] == HASHES
    assert result["seed"] == EVALUATION_SEED


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
def test_a_missing_device_and_another_configuration_are_refused(study: Path, refusal: Any):
    before, again = times(study), ("reproduce", "--out", study)
    assert "CUDA" in refusal(*again, *tiny(device="cuda", seeds="2"))
    assert "evaluation trials" in refusal(*again, *tiny(trials="2"))
    assert times(study) == before


def test_every_combination_of_sweeps_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    trained: dict[str, Train] = {}

    def run_grid(grid: StudyGrid, *_: object) -> None:
        for cell in grid.missing:
            if cell.kind == TRAINING and isinstance(cell.work, partial):
                trained[cell.name] = cell.work.args[0]

    monkeypatch.setattr(studies, "run_grid", run_grid)
    sweeps = ["--sweep", "train.learning-rate", "3e-4", "1e-3", "--sweep", "env.sensing.latency-steps"]
    assert main(["reproduce", *tiny(), *sweeps, "0 0", "3 4", "--out", str(tmp_path)]) == 0
    found = {n: (each.train.learning_rate, each.env.sensing.latency_steps) for n, each in trained.items()}
    assert found == {
        f"only_wh-learning_rate={rate}-env.sensing.latency_steps={low},{high}-seed0": (value, (low, high))
        for rate, value in (("3e-4", 3e-4), ("1e-3", 1e-3))
        for low, high in ((0, 0), (3, 4))
    }
    assert {each.method for each in trained.values()} == {"only_wh"}
    plan = read(tmp_path / "study.json")["plan"]
    assert plan["methods"][0] == "only_wh learning_rate=3e-4 env.sensing.latency_steps=0,0"
    assert "training learning_rate" not in plan["configuration"]
    assert plan["configuration"]["training epochs"] == 5


def test_a_training_is_a_job_of_a_cluster(tmp_path: Path, monkeypatch, capsys, refusal: Any):
    monkeypatch.setattr(grids, "CLUSTER", "local")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    tiny = "--preset cpu --num-envs 4 --transitions 64 --rollout-steps 16 --hidden 8 --physics-stages 60"
    command = ["train", "only_wh", *tiny.split(), "--out", str(tmp_path / "run"), "--slurm", "timeout_min=5"]
    assert main(command) == 0
    log = tmp_path / "run" / "logs" / "run.log"
    assert str(log) in capsys.readouterr().err
    assert "finished: 64 transitions" in log.read_text()
    assert "--resume" in refusal(*command)
