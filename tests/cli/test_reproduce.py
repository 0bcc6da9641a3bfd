"""Studies through the real command: real trainings and evaluations, as small as they can be."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from domains import PATIENCE
from pixel2catch.cli.main import main
from pixel2catch.cli.reproduce import METHODS as STUDY_METHODS
from pixel2catch.methods import METHODS

SMALL = (
    *(
        "--device",
        "cpu",
        "--preset",
        "cpu",
        "--training",
        "transitions=320",
        "env.scene.physics_hz=60",
        "num_envs=4",
    ),
    *("rollout_steps=16", "hidden=16,8", "checkpoint_seconds=0", "env.throws.hover_steps=5,6"),
    *("--num-envs", "2", "--trials", "1"),
)
TINY = (*SMALL, "--methods", "only_wh", "--seeds", "1")
RUN = "only_wh-seed0"


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def times(folder: Path) -> dict[str, int]:
    """When each result was written [ns]."""
    files = [*folder.glob("evaluations/*"), *folder.glob("runs/*/summary.json"), folder / "study.json"]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study that was interrupted in its first training and then continued."""

    folder: Path
    status_when_stopped: int
    summary_when_stopped: dict
    errors_when_stopped: str
    status: int


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    out = tmp_path_factory.mktemp("study") / "with a, comma"
    command = [sys.executable, "-m", "pixel2catch.cli.main", "reproduce", *TINY, "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + PATIENCE
    while not (out / "runs" / RUN / "checkpoint.pt").exists():
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    summary = read(out / "runs" / RUN / "summary.json")
    return Study(
        folder=out,
        status_when_stopped=process.returncode,
        summary_when_stopped=summary,
        errors_when_stopped=errors,
        status=main(["reproduce", *TINY, "--out", str(out)]),
    )


def test_methods_of_a_study_exist():
    assert set(STUDY_METHODS) <= set(METHODS)


def test_an_interrupted_study_saves_its_trainings_and_continues(study: Study):
    assert study.status_when_stopped == 130
    assert study.summary_when_stopped["status"] == "interrupted"
    assert 0 < study.summary_when_stopped["transitions"] < 320
    assert f"{RUN} stopped" in study.errors_when_stopped
    assert study.status == 0
    run = study.folder / "runs" / RUN
    summary = read(run / "summary.json")
    assert (summary["status"], summary["transitions"]) == ("finished", 320)
    assert read(run / "config.json")["env"]["throws"]["hover_steps"] == [5, 6]
    for folder in (run / "sessions.json", study.folder / "study.json"):
        content = json.loads(folder.read_text())
        assert len(content if isinstance(content, list) else content["sessions"]) == 2
    for group in ("seen", "unseen"):
        result = read(study.folder / "evaluations" / f"{RUN}-{group}.json")
        assert (result["method"], result["trials"], result["physics_hz"]) == ("only_wh", 2, 600.0)
        assert "success rate so far" in (study.folder / "logs" / f"{RUN}-{group}.log").read_text()
    rows = read(study.folder / "report" / "table.json")["results"]
    assert [(row["method"], row["objects"], row["trials"]) for row in rows] == [
        ("only_wh", "seen", 2),
        ("only_wh", "unseen", 2),
    ]


def test_only_what_is_missing_is_computed(study: Study, capsys: pytest.CaptureFixture[str]):
    """Another machine can evaluate: the device of a finished training is not needed."""
    before = times(study.folder)
    assert main(["reproduce", *TINY, "--out", str(study.folder)]) == 0
    assert "| only_wh | seen | 1 |" in capsys.readouterr().out
    assert {name: t for name, t in times(study.folder).items() if t != before[name]}.keys() <= {"study.json"}
    deleted = f"evaluations/{RUN}-unseen.json"
    result = read(study.folder / deleted)
    (study.folder / deleted).unlink()
    assert main(["reproduce", *TINY, "--device", "cuda", "--out", str(study.folder)]) == 0
    after = times(study.folder)
    assert {name for name in after if after[name] != before[name]} == {deleted, "study.json"}
    assert read(study.folder / deleted) | {"seconds": 0} == result | {"seconds": 0}


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
def test_a_missing_device_and_another_configuration_are_refused(
    study: Study, capsys: pytest.CaptureFixture[str]
):
    before, out = times(study.folder), ("--out", str(study.folder))
    assert main(["reproduce", *TINY, *out, "--device", "cuda", "--seeds", "2"]) == 2
    assert "CUDA" in capsys.readouterr().err
    assert main(["reproduce", *TINY, *out, "--trials", "2"]) == 2
    assert "evaluation trials: 1 in the study, 2 now" in capsys.readouterr().err
    assert times(study.folder) == before


def test_a_part_that_fails_is_shown_and_the_others_go_on(study: Study, capsys: pytest.CaptureFixture[str]):
    """The second training has a damaged checkpoint: only that one fails, and its evaluations wait."""
    damaged = study.folder / "runs" / "only_wh-seed1" / "checkpoint.pt"
    damaged.parent.mkdir()
    damaged.write_bytes(b"no checkpoint")
    assert main(["reproduce", *TINY, "--out", str(study.folder), "--seeds", "2"]) == 2
    message = capsys.readouterr().err
    assert "only_wh-seed1 failed" in message
    assert "is damaged" in message
    assert damaged.read_bytes() == b"no checkpoint"
    assert len(read(study.folder / "report" / "table.json")["results"]) == 2


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--methods", "propose"), "proposed"),
        (("--training", "num_env=4"), "num_envs"),
        (("--training", "seed=4"), "'seed'"),
        (("--training", "num_envs=0"), "num_envs is 0"),
        (("--report-only",), "study.json"),
        (("--report-only", "--methods", "only_wh", "--seeds", "2"), "leave out --methods, --seeds."),
    ],
)
def test_bad_input_leaves_nothing(
    args: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    assert main(["reproduce", "--device", "cpu", "--out", str(out), *args]) == 2
    assert words in capsys.readouterr().err
    assert not list(out.glob("*.json"))


@pytest.mark.slow
def test_two_methods_with_two_seeds_side_by_side(tmp_path: Path):
    methods = ("--methods", "only_wh", "proposed", "--seeds", "2", "--jobs-per-device", "2")
    command = [sys.executable, "-m", "pixel2catch.cli.main", "reproduce", *SMALL, *methods]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([*command, "--out", str(tmp_path)], env=environment, check=True, timeout=PATIENCE)
    rows = read(tmp_path / "report" / "table.json")["results"]
    assert {(row["method"], row["seeds"], row["trials"]) for row in rows} == {
        ("only_wh", 2, 4),
        ("proposed", 2, 4),
    }
    started = [
        json.loads((tmp_path / "runs" / name / "sessions.json").read_text())[0]["started"]
        for name in ("only_wh-seed0", "proposed-seed0", "only_wh-seed1", "proposed-seed1")
    ]
    assert max(started[:2]) <= min(started[2:])
