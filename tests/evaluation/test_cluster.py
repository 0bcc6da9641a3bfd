"""Jobs that submitit starts: its own executor for one machine in place of SLURM's, and real commands."""

import math
import os
import signal
import sys
from pathlib import Path

import pytest

from pixel2catch.cli.main import main
from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation import cluster
from pixel2catch.evaluation.cluster import Cluster, in_jobs
from pixel2catch.evaluation.comparison.jobs import Job, Runner, Slot, Status, last_lines


@pytest.fixture
def executor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What takes jobs of this machine, whose Python finds what this one does."""
    monkeypatch.setattr(cluster, "CLUSTER", "local")
    monkeypatch.setattr(cluster, "LOOK_SECONDS", 0.05)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    # By which it cancels jobs; what a script starts in the background ignores it, and so would they.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield Cluster(launcher="slurm", slurm=("timeout_min=5", "slurm_partition=any")).executor(tmp_path)
    signal.signal(signal.SIGINT, before)


def job(folder: Path, name: str, *after: str, script: str) -> Job:
    return Job(
        name=name,
        kind="any",
        command=lambda _: ["sh", "-c", f"cd '{folder}'; {script}"],
        is_done=(folder / name).exists,
        after=after,
    )


def test_commands_are_jobs_with_the_same_logs_and_results(executor, tmp_path: Path):
    jobs = [
        job(tmp_path, "a", script="echo said $OMP_NUM_THREADS; touch a"),
        job(tmp_path, "b", "a", script="cp a b"),
        job(tmp_path, "c", script="echo broken; exit 3"),
    ]
    slot = Slot(kind="any", device="cuda", environment={"OMP_NUM_THREADS": "7"})
    runner = Runner(jobs, [slot, slot], tmp_path / "logs", executor=executor)
    runner.run()
    assert runner.status == {"a": Status.DONE, "b": Status.DONE, "c": Status.FAILED}
    assert [last_lines(runner.log(name)) for name in "abc"] == ["said 7", "", "broken"]


def test_jobs_end_in_order_where_the_study_is_stopped(executor, tmp_path: Path):
    script = "trap 'touch saved; exit 0' TERM; touch ready; while true; do sleep 0.01; done"
    runner = Runner(
        [job(tmp_path, "a", script=script)], [Slot(kind="any", device="x")], tmp_path / "logs", None, executor
    )
    runner.run(is_stopped=(tmp_path / "ready").exists)
    assert runner.status == {"a": Status.STOPPED}
    assert (tmp_path / "saved").exists()


def begin() -> None:
    print("begun")


def test_calls_are_jobs(executor, tmp_path: Path):
    assert dict(in_jobs(executor, begin, math.hypot, [(3.0, 4.0), (5.0, 12.0)])) == {0: 5.0, 1: 13.0}
    said = [file.read_text() for file in (tmp_path / "jobs").glob("*_log.out")]
    assert ["begun" in text for text in said] == [True, True]


def fail(reason: str) -> None:
    raise InvalidValueError(reason)


def test_the_error_of_a_job_is_told(executor):
    with pytest.raises(StudyError, match=r"InvalidValueError: too bad; see .*goes on from there"):
        list(in_jobs(executor, begin, fail, [("too bad",)]))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--launcher slurm --slurm slurm_partiton=gpu", "slurm_partiton"),
        ("--launcher slurm --slurm timeout_min=long", "timeout_min"),
        ("--slurm timeout_min=5", "--launcher slurm"),
    ],
)
def test_what_no_cluster_takes(
    options: str,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr(cluster, "CLUSTER", "local")
    assert main(["stress", "--out", str(tmp_path / "out"), *options.split()]) == 2
    assert words in capsys.readouterr().err


def test_a_machine_without_a_cluster(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["reproduce", "--device", "cuda", "--launcher", "slurm", "--out", str(tmp_path / "out")]) == 2
    assert "srun" in capsys.readouterr().err


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(StudyError, match=r"\[slurm\]"):
        Cluster(launcher="slurm").executor(tmp_path)
