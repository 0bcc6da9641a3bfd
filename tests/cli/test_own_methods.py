"""Methods of one's own: what a contract tells of them, and a Python file that registers them."""

import json
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from paper_robot import OWN_CELL
from pixel2catch import own_files
from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import InvalidValueError, PolicyMismatchError
from pixel2catch.methods import MEMORIES, METHODS, find_method
from pixel2catch.own_files import VARIABLE, take_option
from pixel2catch.policy import contract_of, method_of

FILE = """
from dataclasses import replace
from pixel2catch.mdp.observations import PAPER_TERMS
from pixel2catch.evaluation.stress import Axis, Level
from pixel2catch.methods import PROPOSED
from pixel2catch.scene.objects import make_object
from pixel2catch.scene.shapes import box

def palm_height(frame):
    return frame.now.palm_pos[:, 0, 2:]

size_alone = replace(PROPOSED, name="size_alone", pixel_features=("w", "h"))
seeing = tuple(replace(agent, observation=(*PAPER_TERMS, palm_height)) for agent in PROPOSED.agents)
def heavier(task):
    return replace(task, randomization=replace(task.randomization, mass_scale=(2.0, 2.0)))

brick = make_object("brick", box(0.04, 0.05, 0.06), mass=0.1)
heavy = Axis(name="heavy", unit="g", levels=(Level(label="60", change=heavier, source="ours"),))
with_height = replace(PROPOSED, name="with_height", agents=seeing)
"""
LATE = """
import os, signal
from dataclasses import replace
from pixel2catch.methods import METHODS
from pixel2catch.mdp.rewards import RewardTerm
calls = []

def late(transition, part):
    calls.append(0)
    if len(calls) > 3:
        WHAT
    return transition.now.object_pos[:, 0]

(agent,) = METHODS["single_agent"].agents
part = replace(agent.parts[0], reward=(RewardTerm(function=late, weight=1.0),))
mine = replace(METHODS["single_agent"], name="mine", agents=(replace(agent, parts=(part, *agent.parts[1:])),))
"""
SIZE = ("--num-envs", "4", "--rollout-steps", "2", "--mini-batches", "2", "--transitions", "16")
TRAINING = (*SIZE, "--hidden", "8", "--device", "cpu")
THROWS = ("--num-envs", "2", "--trials", "1", "--env.scene.physics-hz", "30", "--objects", "cube_s")


@contextmanager
def new_process() -> Iterator[None]:
    """Forget the files of one's own before and after, as a process of its own does."""
    before = [(values, dict(values)) for values, _ in own_files._CATALOGUES.values()]
    variable = os.environ.get(VARIABLE, "")
    os.environ[VARIABLE] = ""
    try:
        yield
    finally:
        for values, known in before:
            values.clear()
            values.update(known)
        for path in own_files._MODULES:
            sys.modules.pop(Path(path).stem)
        own_files._MODULES.clear()
        os.environ[VARIABLE] = variable


def run(*args: str) -> int:
    with new_process():
        return main(list(args))


@pytest.mark.parametrize("memory", ["", *(f"+{name}" for name in MEMORIES)])
def test_a_contract_tells_what_a_method_of_package_terms_observes(memory: str):
    for name in METHODS:
        method = find_method(name + memory)
        own = replace(method, name=f"mine{memory}")
        found = method_of(contract_of(own))
        assert contract_of(found) == contract_of(own)
        assert (found.pixel_features, found.num_boxes) == (method.pixel_features, method.num_boxes)
        for mine, theirs in zip(found.agents, method.agents, strict=True):
            assert (mine.observation, mine.memory) == (theirs.observation, theirs.memory)
            assert (mine.name, mine.joints) == (theirs.name, theirs.joints)
        assert memory or method_of(contract_of(method)) is method


def test_how_many_boxes_an_own_memory_holds_is_not_told():
    remembering = replace(find_method("proposed+fit"), name="mine", num_boxes=4)
    with pytest.raises(PolicyMismatchError, match=r"remembers.*--import"):
        method_of(contract_of(remembering))


def test_the_option_is_taken_wherever_it_stands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, "")
    given = ["--import", "a.py", "evaluate", "run", "--import=b.py", "--workcell", "cell.py"]
    assert take_option(given) == ["evaluate", "run", "--workcell", "cell.py"]
    assert os.environ[VARIABLE] == os.pathsep.join(str(tmp_path / f"{name}.py") for name in ("a", "b"))


def test_a_value_of_the_package_is_not_replaced():
    with pytest.raises(InvalidValueError, match="Method 'proposed' is in the package"):
        own_files.add(replace(METHODS["proposed"], pixel_features=("w", "h")))


def test_own_methods_are_trained_and_evaluated(tmp_path: Path, monkeypatch, capsys):
    """Without the file where all terms are the package's; child processes import it, too."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(CatchEnvCfg, "trial_steps", 20)
    Path("my_methods.py").write_text(FILE)
    for name in ("size_alone", "with_height"):
        assert run("train", name, "--import", "my_methods.py", *TRAINING, "--out", name) == 0
    file = tmp_path / "my_methods.py"
    assert f"next: pixel2catch --import {file} evaluate with_height" in capsys.readouterr().err
    results = []
    for more in ((), ("--import", "my_methods.py")):
        assert run("evaluate", "size_alone", *THROWS, "--json", *more) == 0
        results.append(json.loads(capsys.readouterr().out) | {"seconds": 0, "circumstances": None})
    assert results[0] == results[1]
    assert run("evaluate", "with_height", *THROWS) == 2
    assert re.search(r"unknown method 'with_height'.*--import FILE\.py", capsys.readouterr().err)
    thrown = (*THROWS[:-1], "brick")
    options = ("--import", "my_methods.py", "--axes", "heavy", "--out", "stress")
    assert run("stress", "size_alone", "with_height", *thrown, *options) == 0
    for name in ("size_alone", "with_height"):
        cell = json.loads(Path("stress", "cells", name, "heavy-60.json").read_text())
        assert cell["method"] == name
        assert cell["evaluation"]["objects"] == ["brick"]
        assert cell["evaluation"]["task"]["randomization"]["mass_scale"] == [2.0, 2.0]


@pytest.mark.parametrize(
    ("what", "status", "ended", "words"),
    [
        ("calls.none", 2, "failed", r"'late' \(.*late.py', line 11\): AttributeError: .*; correct it"),
        ("return transition.now.object_pos", 2, "failed", r"'late' \(.*late.py', line 8\) returns the shape"),
        ("os.kill(os.getpid(), signal.SIGTERM)", 143, "interrupted", "pixel2catch: terminated"),
        ("os.kill(os.getpid(), signal.SIGINT)", 130, "interrupted", "pixel2catch: interrupted"),
    ],
)
def test_what_a_term_does_late_is_named(what, status, ended, words, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("late.py").write_text(LATE.replace("WHAT", what))
    assert run("train", "mine", "--import", "late.py", *TRAINING, "--out", "run") == status
    output = capsys.readouterr()
    assert re.search(words, output.err)
    assert json.loads(Path("run", "summary.json").read_text())["status"] == ended
    assert Path("run", "checkpoint.pt").exists() == ("--resume" in output.out) == (ended == "interrupted")


def test_a_work_cell_of_ones_own_is_trained_and_evaluated(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(CatchEnvCfg, "trial_steps", 20)
    Path("my_cell.py").write_text(OWN_CELL)
    mine = ("--import", "my_cell.py")
    assert run("train", "proposed", "--workcell", "mine", *TRAINING, *mine, "--out", "run") == 0
    assert run("evaluate", "run", *THROWS) == 2
    assert re.search(r"unknown work cell 'mine'.*--import FILE\.py", capsys.readouterr().err)
    assert run("evaluate", "run", *THROWS, "--json", "--import", "my_cell.py") == 0
    assert json.loads(capsys.readouterr().out)["method"] == "proposed"
