"""A series of real throws: its plan, its folder, what is measured, asked and reported."""

import json
import os
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from pixel2catch.cli.link import Network
from pixel2catch.cli.main import main
from pixel2catch.cli.trial_series import TrialSeries, new_plan
from pixel2catch.cli.trials import Trials
from pixel2catch.deployment import throw_cycle
from pixel2catch.deployment.control_loop import StepClock
from pixel2catch.deployment.operator import OperatorConsole
from pixel2catch.evaluation.trials import draw_plan, paired_rows, rate_rows
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.twin import TaskArgs

ONE = ("--policies", "proposed", "--objects", "cube", "--throws", "1", "--seed", "3")
IN_TWIN = (*ONE, "--rehearse=--lockstep --plain")


def test_a_plan_is_random_and_balanced():
    throws = [*draw_plan(["cube", "l_block"], ["a", "b", "c"], 6, seed=1)]
    assert [each["number"] for each in throws] == [*range(1, 37)]
    turns: Counter[Any] = Counter()
    for block in range(6):
        rows = throws[6 * block : 6 * block + 6]
        assert {each["block"] for each in rows} == {block + 1}
        for place in (0, 3):
            row = rows[place : place + 3]
            assert len({each["object"] for each in row}) == 1
            assert {each["policy"] for each in row} == {"a", "b", "c"}
            turns.update((each["object"], each["policy"], turn) for turn, each in enumerate(row))
    assert set(turns.values()) == {2}
    assert throws == [*draw_plan(["cube", "l_block"], ["a", "b", "c"], 6, seed=1)]
    assert throws != [*draw_plan(["cube", "l_block"], ["a", "b", "c"], 6, seed=2)]


def test_rates_and_pairs_by_hand():
    """Of a: caught, reached; of b: dropped, reached. T.R. 2 and 1 of 2, S.R. 1 and 0 of 2."""
    outcomes = {("a", 1): "caught", ("a", 2): "reached", ("b", 1): "dropped", ("b", 2): "reached"}
    throws = [{"policy": p, "block": b, "object": "cube", "outcome": o} for (p, b), o in outcomes.items()]
    shares = {(row["rate"], row["object"]): row["share"] for row in rate_rows(throws)}
    assert shares["T.R. a", "cube"] == shares["T.R. a", "all"] == 1.0
    assert (shares["T.R. b", "all"], shares["S.R. a", "all"], shares["S.R. b", "all"]) == (0.5, 0.5, 0.0)
    expected = {"policy": "b", "pairs": 2, "lost": 1, "won": 0, "difference": -0.5}
    for row in paired_rows(throws, "a"):
        assert row.items() >= expected.items()


@pytest.fixture(scope="module")
def series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A series in the stepped twin: one throw of a cube, which is carried away fast."""
    out = tmp_path_factory.mktemp("trials") / "series"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(throw_cycle, "SHARE", 0.9)
        make = TaskArgs.make
        patch.setattr(TaskArgs, "make", lambda *args: replace(make(*args), scene=SceneCfg(physics_hz=120.0)))
        assert main(["trials", *IN_TWIN, "--out", str(out)]) == 0
    return out


def test_a_series_runs_against_the_twin(series: Path):
    (throw,) = json.loads((series / "table.json").read_text())["throws"]
    assert (throw["outcome"], throw["proposed"], throw["policy"]) == ("caught", "caught", "proposed")
    assert "throws/0001/strip.png" in (series / "table.md").read_text()
    assert (series / "throws" / "0001" / "strip.png").stat().st_size > 100_000


def test_a_finished_series_is_reported_again_and_another_one_is_refused(series: Path, refusal: Any):
    before = (series / "plan.json").read_bytes()
    assert main(["trials", *IN_TWIN, "--out", str(series)]) == 0
    words = "another series (throws: 1 in the series, 2 now)"
    assert words in refusal("trials", *[{"1": "2"}.get(each, each) for each in IN_TWIN], "--out", series)
    assert (series / "plan.json").read_bytes() == before


DEPLOY = """
import json, os, shutil, sys, time
shutil.copytree(os.environ["TAPE"], sys.argv[-1])
status = {"mode": "run", "found": [], "stopped_by": [], "refused": [], "message": ""}
for cycle in ("wait", "throw", "move", "wait"):
    print(json.dumps(status | {"cycle": cycle}), flush=True)
time.sleep(60)
"""
"""A program in place of `deploy`, which copies a recording."""


@pytest.fixture
def robot(series: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A series whose throws are taken by `DEPLOY`, with a network in memory; keys go into a pipe."""
    program = tmp_path / "python"
    program.write_text(f"#!{sys.executable}\n{DEPLOY}")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setenv("TAPE", str(series / "throws" / "0001" / "recording"))
    clock, broker = StepClock(lambda _: None), Broker()
    monkeypatch.setattr(Network, "join", lambda *_: nullcontext((broker.node(clock), clock)))
    reading, writing = os.pipe()
    console = OperatorConsole(broker.node(clock), Profile.load("ur5e_allegro_v4").operator, clock)
    with os.fdopen(reading) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield console, lambda keys: os.write(writing, keys.encode())
    os.close(writing)


def test_keys_and_the_page_judge_throws_also_after_a_kill(robot: Any, series: Path, tmp_path: Path):
    console, press = robot
    out, is_done = tmp_path / "out", Event()
    cfg = vars(Trials(policies=(Path("proposed"),), objects=("cube",), throws=3, out=out))
    throws, leader = new_plan(cfg)["throws"], TrialSeries(cfg)
    press("z\n")  # z is no answer; Enter confirms
    leader.take(throws[0])
    press("x")
    leader.take(throws[1])
    assert not (out / "throws" / "0002").exists()
    assert (out / "throws" / "0002-repeated-1" / "recording").is_dir()
    shutil.copytree(series / "throws" / "0001" / "recording", out / "throws" / "0002" / "recording")

    def push_the_button() -> None:
        while not is_done.wait(0.01):
            console.answer("dropped")

    page = Thread(target=push_the_button)
    page.start()
    leader.take(throws[1])  # it was recorded before the program was killed: nothing moves
    is_done.set()
    page.join()
    assert not (out / "throws" / "0002" / "deploy.txt").exists()
    (out / "throws" / "0003" / "recording").mkdir(parents=True)  # it was killed before the flight
    leader.take(throws[2])
    assert (out / "throws" / "0003-repeated-1").exists()
    rows = [json.loads((out / f"throws/000{n}/row.json").read_text()) for n in (1, 2)]
    assert {row["proposed"] for row in rows} == {"caught"}
    assert [row["outcome"] for row in rows] == ["caught", "dropped"]


def test_a_deployment_without_a_throw_ends_it(robot: Any, tmp_path: Path, refusal: Any):
    Path(sys.executable).write_text("#!/bin/sh\necho 'error: no camera' >&2\nexit 2\n")
    assert "ended before a throw: error: no camera" in refusal("trials", *ONE, "--out", tmp_path / "out")
