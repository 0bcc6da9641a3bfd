"""Every script of `examples/` runs as it stands, with tiny settings."""

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from pixel2catch.scene.objects import OBJECTS
from pixel2catch.workcells import workcells

FOLDER = Path(__file__).parents[1] / "examples"
TRAINING = {"transitions": 256 * 4, "num_envs": 32}
EXAMPLES: dict[str, tuple[Mapping[str, float], str]] = {
    "evaluate_policies": ({"num_envs": 2, "physics_hz": 120.0}, "proposed, 300 g: "),
    "last_five_boxes": (TRAINING, "('last_boxes[t]', 25)"),
    "own_learner": ({"num_envs": 4, "updates": 2, "steps": 4}, "update 1: mean reward "),
    "own_method": (TRAINING, "finished size_and_age"),
    "own_object": ({"num_envs": 4, "physics_hz": 120.0}, "'cup': "),
    "own_reward": (TRAINING, "arm.held_speed: "),
    "own_robot": ({"num_envs": 2}, "nearer ["),
    "robot_from_mjcf": (TRAINING, "finished: reached 0."),
}
"""Settings of each example, and what it prints."""


@pytest.fixture
def catalogues() -> Iterator[None]:
    """What an example adds to the catalogues goes again."""
    catalogues: list[dict[str, Any]] = [OBJECTS, workcells()]
    before: list[dict[str, Any]] = [dict(values) for values in catalogues]
    yield
    for values, kept in zip(catalogues, before, strict=True):
        values.clear()
        values.update(kept)


def main_of(name: str) -> Callable[..., None]:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def test_every_example_is_here_and_short():
    files = {path.stem: path.read_text().splitlines() for path in FOLDER.glob("*.py")}
    assert set(files) == set(EXAMPLES)
    assert all(len(lines) <= 50 for lines in files.values())


SLOW = ("last_five_boxes", "own_method")  #: They train as `own_reward` does.


@pytest.mark.usefixtures("catalogues", "small_cells")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in EXAMPLES]
)
def test_it_runs(name: str, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings, printed = EXAMPLES[name]
    main_of(name)(**settings)
    assert printed in capsys.readouterr().out
