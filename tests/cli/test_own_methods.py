"""Methods of one's own: what a contract tells of them, and a Python file that registers them."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from commands import pixel2catch
from pixel2catch.errors import PolicyMismatchError
from pixel2catch.methods import MEMORIES, METHODS, find_method
from pixel2catch.own_files import VARIABLE, take_option
from pixel2catch.policy import contract_of, method_of

FILE = """
from dataclasses import replace
from pixel2catch.mdp.observations import PAPER_TERMS
from pixel2catch.evaluation.stress.suite import Axis, Level
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
SIZE = ("--num-envs", "4", "--rollout-steps", "2", "--mini-batches", "2", "--transitions", "16")
TRAINING = (*SIZE, "--hidden", "8", "--device", "cpu")
THROWS = ("--num-envs", "2", "--trials", "1", "--physics-hz", "30", "--objects", "cube_s")


@pytest.mark.parametrize("memory", ["", *(f"+{name}" for name in MEMORIES)])
@pytest.mark.parametrize("name", METHODS)
def test_a_contract_tells_what_a_method_of_package_terms_observes(name: str, memory: str):
    method = find_method(name + memory)
    own = replace(method, name=f"mine{memory}")
    found = method_of(contract_of(own))
    assert contract_of(found) == contract_of(own)
    assert (found.pixel_features, found.num_boxes) == (method.pixel_features, method.num_boxes)
    for mine, theirs in zip(found.agents, method.agents, strict=True):
        assert (mine.observation, mine.memory) == (theirs.observation, theirs.memory)
        assert (mine.name, mine.joints) == (theirs.name, theirs.joints)


def test_a_method_of_the_package_is_its_own():
    for method in METHODS.values():
        assert method_of(contract_of(method)) is method


def test_how_many_boxes_an_own_memory_holds_is_not_told():
    remembering = replace(find_method("proposed+fit"), name="mine", num_boxes=4)
    with pytest.raises(PolicyMismatchError, match=r"remembers.*--import"):
        method_of(contract_of(remembering))


def test_the_option_is_taken_wherever_it_stands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, "")
    given = ["--import", "a.py", "evaluate", "run", "--import=b.py", "c.py:mine+fit", "--objects=./b.py:mug"]
    assert take_option(given) == ["evaluate", "run", "mine+fit", "--objects=mug"]
    assert take_option(["C:/a.py", "--workcell", "cell.py"]) == ["C:/a.py", "--workcell", "cell.py"]
    assert os.environ[VARIABLE] == os.pathsep.join(str(tmp_path / f"{name}.py") for name in ("a", "b", "c"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the file and a training of each of its methods."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_methods.py").write_text(FILE)
    for name in ("size_alone", "with_height"):
        done = pixel2catch("train", f"my_methods.py:{name}", *TRAINING, "--out", name, folder=folder)
        assert done.returncode == 0, done.stderr
    return folder


def test_a_run_of_an_own_method_is_evaluated_with_and_without_its_file(runs: Path):
    command = ("evaluate", "size_alone", *THROWS, "--json")
    results = [
        pixel2catch(*command, folder=runs),
        pixel2catch(*command, "--import", "my_methods.py", folder=runs),
    ]
    first, second = (json.loads(result.stdout) | {"seconds": 0} for result in results)
    assert first == second
    assert first["method"] == "size_alone"


def test_a_term_of_ones_own_needs_its_file(runs: Path):
    refused = pixel2catch("evaluate", "with_height", *THROWS, folder=runs)
    assert refused.returncode == 2
    assert "observes 'palm_height'" in refused.stderr
    assert "--import FILE.py" in refused.stderr
    absent = pixel2catch("--import", "absent.py", "evaluate", "with_height", folder=runs)
    assert (absent.returncode, "cannot import" in absent.stderr) == (2, True)


def test_with_its_file_a_term_of_ones_own_is_evaluated_and_filmed(runs: Path):
    own = ("with_height", "--import", "my_methods.py")
    evaluated = pixel2catch("evaluate", *own, *THROWS, "--json", folder=runs)
    assert evaluated.returncode == 0, evaluated.stderr
    assert json.loads(evaluated.stdout)["method"] == "with_height"
    video = ("--throws", "1", "--objects", "cube_s", "--view", "rgb", "--out", "own.mp4")
    filmed = pixel2catch("play", *own, *video, folder=runs)
    assert filmed.returncode == 0, filmed.stderr
    assert (runs / "own.mp4").stat().st_size > 0


def test_child_processes_know_the_file(runs: Path):
    """Of methods, of an object, and of a disturbance, which is sent to them."""
    thrown = (*THROWS[:-1], "my_methods.py:brick")
    options = ("--axes", "my_methods.py:heavy", "--jobs", "2", "--out", "stress", "--json")
    result = pixel2catch("stress", "size_alone", "with_height", *thrown, *options, folder=runs)
    assert result.returncode == 0, result.stderr
    table = json.loads(result.stdout)
    policies = table["policies"]
    cell = json.loads((runs / "stress" / "cells" / "with_height" / "heavy-60.json").read_text())
    assert cell["evaluation"]["objects"] == ["brick"]
    assert cell["evaluation"]["task"]["randomization"]["mass_scale"] == [2.0, 2.0]
    assert {name: each["method"] for name, each in policies.items()} == {
        name: name for name in ("size_alone", "with_height")
    }


CELL = """
from dataclasses import replace

from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

(robot,) = UR5E_ALLEGRO.robots
WORKCELLS = (replace(UR5E_ALLEGRO, name="nearer", robots=(replace(robot, pos=(0.1, 0.0, 0.821)),)),)
"""


def test_a_work_cell_of_ones_own_is_trained_and_evaluated(tmp_path: Path):
    (tmp_path / "my_cell.py").write_text(CELL)
    done = pixel2catch(
        "train", "proposed", "--workcell", "my_cell.py", *TRAINING, "--out", "run", folder=tmp_path
    )
    assert done.returncode == 0, done.stderr
    command = ("evaluate", "run", *THROWS, "--json")
    lost, found = (pixel2catch(*command, *more, folder=tmp_path) for more in ((), ("--import", "my_cell.py")))
    assert lost.returncode == 2
    assert "unknown work cell 'nearer'" in lost.stderr
    assert "--import FILE.py" in lost.stderr
    assert json.loads(found.stdout)["method"] == "proposed", found.stderr
