"""The budgets of `budgets.toml`: lines, files and options. A commit that raises one says why."""

import json
from collections.abc import Iterable
from pathlib import Path

import pytest

from paths import BUDGETS

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "pixel2catch"


def lines(paths: Iterable[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def python(*folders: str) -> list[Path]:
    return [path for folder in folders for path in (ROOT / folder).rglob("*.py")]


def all_python() -> dict[bool, list[Path]]:
    """Return the files that are tests, and the others."""
    tests, others = python("tests"), python("src", "benchmarks", "ros")
    for path in python("companions"):
        (tests if path.name.startswith("test_") else others).append(path)
    return {True: tests, False: others}


def room_files(room: str) -> list[Path]:
    return [*SOURCE.glob("*.py")] if room == "ground" else [*(SOURCE / room).rglob("*.py")]


MEASURES = {
    "source_lines": lambda: lines(python("src")),
    "source_files": lambda: len(python("src")),
    "all_but_tests_lines": lambda: lines(all_python()[False]),
    "javascript_lines": lambda: lines((ROOT / "src").rglob("*.js")),
    "test_lines": lambda: lines(all_python()[True]),
}


@pytest.mark.parametrize("name", MEASURES)
def test_the_whole_keeps_its_budget(name: str):
    assert MEASURES[name]() <= BUDGETS["whole"][name]


def test_every_room_keeps_its_budget():
    rooms = {path.name for path in SOURCE.iterdir() if [*path.glob("*.py")]} | {"ground"}
    budgets = BUDGETS["rooms"]
    assert {room for rooms in budgets for room in rooms.split("+")} == rooms
    sizes = {
        rooms: lines(path for room in rooms.split("+") for path in room_files(room)) for rooms in budgets
    }
    assert {name: size for name, size in sizes.items() if size > budgets[name]} == {}


def test_commands_have_few_options():
    """Without --help and the fields of the task; `test_stability.py` lists them."""
    listed = json.loads((ROOT / "tests" / "stable.json").read_text("utf-8"))["commands"]
    counts = {name: sum(option.startswith("-") for option in options) for name, options in listed.items()}
    assert sum(counts.values()) <= BUDGETS["whole"]["options"], counts
