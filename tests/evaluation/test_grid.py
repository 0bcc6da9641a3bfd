"""The grid: cells in workers, and as jobs of submitit's executor for one machine."""

import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from pixel2catch.errors import InvalidValueError, StudyError
from pixel2catch.evaluation import grid as grids
from pixel2catch.evaluation.grid import (
    ClusterJob,
    Slot,
    Status,
    StudyCell,
    StudyGrid,
    Worker,
    cluster_executor,
)

DONE, FAILED, WAITING, STOPPED = Status.DONE, Status.FAILED, Status.WAITING, Status.STOPPED


def write(file: Path, device: str) -> None:
    with open(file.parent / "order", "a") as order:
        order.write(f"{file.name} ")
    print("printed", os.environ.get("MARK"))
    file.write_text(device)


def fail(file: Path, device: str) -> None:
    raise InvalidValueError("too bad")


def write_nothing(file: Path, device: str) -> None:
    pass


def die(file: Path, device: str) -> None:
    os._exit(1)


def save_when_stopped(file: Path, device: str) -> None:
    signal.signal(signal.SIGTERM, lambda *_: (file.with_name("saved").touch(), sys.exit(0)))
    file.with_name("ready").touch()
    while True:
        time.sleep(0.01)


def cell(folder: Path, name: str, *after: str, work=write, kind: str = "") -> StudyCell:
    file = folder / name
    return StudyCell(name=name, work=partial(work, file), is_done=file.exists, after=after, kind=kind)


def order(folder: Path) -> list[str]:
    return (folder / "order").read_text().split()


def test_cells_run_in_order_after_what_they_need(tmp_path: Path):
    cells = [
        cell(tmp_path, "train-a", kind="train"),
        cell(tmp_path, "judge-a", "train-a", kind="judge"),
        cell(tmp_path, "train-b", kind="train"),
        cell(tmp_path, "judge-b", "train-b", kind="judge"),
    ]
    grid = StudyGrid(cells)
    grid.run([Worker("judge", "x"), Worker("train", "y")])
    assert set(grid.status.values()) == {DONE}
    made = order(tmp_path)
    for before, after in (("train-a", "train-b"), ("train-a", "judge-a"), ("train-b", "judge-b")):
        assert made.index(before) < made.index(after)
    assert [(tmp_path / name).read_text() for name in ("train-a", "judge-a")] == ["y", "x"]


def test_only_missing_cells_and_what_follows_them_are_computed(tmp_path: Path):
    for name in ("a", "c"):
        (tmp_path / name).touch()
    grid = StudyGrid([cell(tmp_path, "a"), cell(tmp_path, "b", "a"), cell(tmp_path, "c", "b")])
    assert grid.status == {"a": DONE, "b": WAITING, "c": WAITING}
    grid.run([Worker("", "x")])
    assert order(tmp_path) == ["b", "c"]


@pytest.mark.parametrize(
    ("work", "error"), [(fail, "too bad"), (write_nothing, "without a result"), (print, "TypeError")]
)
def test_a_failure_holds_up_only_what_depends_on_it(work, error: str, tmp_path: Path):
    broken = partial(work, nonsense=1) if work is print else work
    grid = StudyGrid([cell(tmp_path, "a", work=broken), cell(tmp_path, "b", "a"), cell(tmp_path, "c")])
    grid.run([Worker("", "x")])
    assert grid.status == {"a": FAILED, "b": WAITING, "c": DONE}
    with pytest.raises(StudyError, match=f"a failed: .*{error}"):
        grid.require_whole()


def test_workers_have_devices_environments_and_logs_and_may_be_killed(tmp_path: Path):
    """The worker that computes `a` is ended from outside; its slot goes on with `c`."""
    cells = [
        cell(tmp_path, "a", work=die, kind="first"),
        cell(tmp_path, "b", kind="second"),
        cell(tmp_path, "c", kind="first"),
    ]
    places: list[Slot] = [Worker("first", "x"), Worker("second", "y", {"MARK": "7"}, is_reused=False)]
    grid = StudyGrid(cells)
    grid.run(places, logs=tmp_path / "logs")
    assert grid.status == {"a": FAILED, "b": DONE, "c": DONE}
    assert "ended from outside" in grid.errors["a"]
    assert [(tmp_path / name).read_text() for name in "bc"] == ["y", "x"]
    assert (tmp_path / "logs" / "b.log").read_text() == "printed 7\n"
    assert "MARK" not in os.environ


def test_ctrl_c_lets_workers_end_in_order(tmp_path: Path):
    def watch() -> None:
        if (tmp_path / "ready").exists() and not (tmp_path / "asked").exists():
            (tmp_path / "asked").touch()
            os.kill(os.getpid(), signal.SIGINT)

    grid = StudyGrid([cell(tmp_path, "a", work=save_when_stopped), cell(tmp_path, "b")])
    with pytest.raises(KeyboardInterrupt):
        grid.run([Worker("", "x")], watch)
    assert grid.status == {"a": STOPPED, "b": WAITING}
    assert (tmp_path / "saved").exists()


def test_cells_are_jobs_of_a_cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(grids, "CLUSTER", "local")
    monkeypatch.setattr(ClusterJob, "poll_seconds", 0.05)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    executor = cluster_executor(("timeout_min=5", "slurm_partition=any"), tmp_path)
    assert executor
    places = [ClusterJob("", "cuda", executor), ClusterJob("", "cuda", executor)]
    grid = StudyGrid([cell(tmp_path, "a"), cell(tmp_path, "b", "a", work=fail)])
    grid.run(places, logs=tmp_path / "logs")
    assert grid.status == {"a": DONE, "b": FAILED}
    assert grid.errors["b"] == "too bad"
    assert (tmp_path / "a").read_text() == "cuda"
    assert "printed" in (tmp_path / "logs" / "a.log").read_text()


@pytest.mark.parametrize("asked", ["slurm_partiton=gpu", "timeout_min=long"])
def test_requests_that_the_cluster_refuses(asked: str, tmp_path: Path, monkeypatch, refusal):
    monkeypatch.setattr(grids, "CLUSTER", "local")
    assert asked.partition("=")[0] in refusal("stress", "--out", tmp_path / "out", "--slurm", asked)


def test_a_machine_without_cluster_or_submitit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(StudyError, match="srun"):
        cluster_executor(("timeout_min=5",), tmp_path)
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(StudyError, match=r"\[slurm\]"):
        cluster_executor(("timeout_min=5",), tmp_path)
