"""The runner, with real commands that take no time."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from domains import PATIENCE
from pixel2catch.errors import StudyError
from pixel2catch.evaluation.comparison.jobs import Job, Runner, Slot, Status, last_lines, locked

DONE, FAILED, WAITING, STOPPED = Status.DONE, Status.FAILED, Status.WAITING, Status.STOPPED


def job(folder: Path, name: str, *after: str, script: str | None = None, kind: str = "any") -> Job:
    """A job that notes that it ran, and on which device, unless it does something else."""
    note = f"echo {name} >> order; echo $DEVICE > {name}"
    command = f"cd '{folder}'; export DEVICE=$0; {script or note}"
    return Job(
        name=name,
        kind=kind,
        command=lambda device: ["sh", "-c", command, device],
        is_done=lambda: (folder / name).exists(),
        after=after,
    )


def slots(number: int = 1, kind: str = "any") -> list[Slot]:
    return [Slot(kind=kind, device=f"device{i}") for i in range(number)]


def order(folder: Path) -> list[str]:
    return (folder / "order").read_text().split()


def test_parts_run_in_order_behind_what_they_need(tmp_path: Path):
    jobs = [
        job(tmp_path, "train-a", kind="train"),
        job(tmp_path, "judge-a", "train-a", kind="judge"),
        job(tmp_path, "train-b", kind="train"),
        job(tmp_path, "judge-b", "train-b", kind="judge"),
    ]
    runner = Runner(jobs, [*slots(kind="train"), *slots(kind="judge")], tmp_path / "logs")
    runner.run()
    assert set(runner.status.values()) == {DONE}
    ran = order(tmp_path)
    assert ran.index("train-a") < ran.index("train-b")
    assert all(ran.index(f"train-{name}") < ran.index(f"judge-{name}") for name in "ab")


def test_what_is_done_is_not_done_again(tmp_path: Path):
    (tmp_path / "a").touch()
    runner = Runner([job(tmp_path, "a"), job(tmp_path, "b", "a")], slots(), tmp_path / "logs")
    assert runner.status == {"a": DONE, "b": WAITING}
    runner.run()
    assert order(tmp_path) == ["b"]


def test_what_follows_an_unfinished_part_is_done_anew(tmp_path: Path):
    (tmp_path / "b").touch()
    runner = Runner([job(tmp_path, "a"), job(tmp_path, "b", "a")], slots(), tmp_path / "logs")
    runner.run()
    assert order(tmp_path) == ["a", "b"]


@pytest.mark.parametrize("script", ["echo broken >&2; exit 3", "true", "touch a; exit 1"])
def test_a_failure_holds_up_only_what_depends_on_it(script: str, tmp_path: Path):
    """Failed: an exit status, no result, or a result and an exit status."""
    jobs = [job(tmp_path, "a", script=script), job(tmp_path, "b", "a"), job(tmp_path, "c")]
    runner = Runner(jobs, slots(), tmp_path / "logs")
    runner.run()
    assert runner.status == {"a": FAILED, "b": WAITING, "c": DONE}
    assert last_lines(runner.log("a")) == ("broken" if "broken" in script else "")


def test_lanes_run_side_by_side_each_on_its_device(tmp_path: Path):
    """Each waits for the other: with one slot they would never end."""
    meet = "echo $DEVICE > {0}; while [ ! -e {1} ]; do sleep 0.01; done"
    jobs = [
        job(tmp_path, "a", script=meet.format("a", "b")),
        job(tmp_path, "b", script=meet.format("b", "a")),
    ]
    runner = Runner(jobs, slots(2), tmp_path / "logs")
    runner.run()
    assert {(tmp_path / name).read_text().strip() for name in "ab"} == {"device0", "device1"}


def test_a_lane_gives_its_environment(tmp_path: Path):
    slot = Slot(kind="any", device="x", environment={"OMP_NUM_THREADS": "7"})
    Runner([job(tmp_path, "a", script="echo $OMP_NUM_THREADS > a")], [slot], tmp_path / "logs").run()
    assert (tmp_path / "a").read_text() == "7\n"


def test_stopping_lets_parts_end_in_order(tmp_path: Path):
    script = "trap 'echo saved > checkpoint; exit 0' TERM; touch ready; while true; do sleep 0.01; done"
    jobs = [job(tmp_path, "a", script=script), job(tmp_path, "b")]
    runner = Runner(jobs, slots(), tmp_path / "logs")
    runner.run(is_stopped=lambda: (tmp_path / "ready").exists())
    assert runner.status == {"a": STOPPED, "b": WAITING}
    assert (tmp_path / "checkpoint").read_text() == "saved\n"


def test_an_error_while_watching_leaves_nothing_running(tmp_path: Path):
    def watch(status: object) -> None:
        if (tmp_path / "pid").exists():
            raise RuntimeError("the terminal is gone")

    runner = Runner([job(tmp_path, "a", script="echo $$ > pid; sleep 60")], slots(), tmp_path / "logs")
    with pytest.raises(RuntimeError, match="terminal"):
        runner.run(watch)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


ORPHANING = """
import sys
from pathlib import Path
from pixel2catch.evaluation.comparison.jobs import Slot, Job, Runner, locked
folder = Path(sys.argv[1])
command = ["sh", "-c", f"echo $$ > '{folder}/pid.tmp'; mv '{folder}/pid.tmp' '{folder}/pid'; exec sleep 60"]
with locked(folder) as lock:
    job = Job(name="a", kind="any", command=lambda _: command, is_done=lambda: False)
    Runner([job], [Slot(kind="any", device="x")], folder / "logs", lock).run()
"""


def test_a_part_that_outlives_its_runner_keeps_the_folder(tmp_path: Path):
    runner = subprocess.Popen([sys.executable, "-c", ORPHANING, str(tmp_path)])
    wait_for((tmp_path / "pid").exists)
    runner.kill()
    runner.wait()
    with pytest.raises(StudyError, match="in use"), locked(tmp_path):
        pass
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)

    def is_free() -> bool:
        try:
            with locked(tmp_path):
                return True
        except StudyError:
            return False

    wait_for(is_free)
