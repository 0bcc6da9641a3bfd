"""The numbers of documents come from files: tables, behaviour, waivers and seeds of the declared studies."""

import datetime
import json
import re
import shlex
from pathlib import Path

import pytest

from pixel2catch.behaviour import HASHES
from pixel2catch.cli.main import parse
from pixel2catch.reports import DASH
from results import FOLDER, PLACE, ROOT, Studies, main

NEVER = datetime.date.min  #: Waivers end in `make check`, not in the tests of a release.
NAME = "ur5e_allegro"
PAGE = """# Rates

<!-- table: rates -->
|  | S.R. | lost |
| --- | ---: | ---: |
| seen | {rate} | {lost} |
<!-- end -->
"""
RESULT = {
    "success_rate": 0.5,
    "success_rate_interval": [0.401, 0.599],
    "failures": {"lost": 3},
    "circumstances": {"behaviour": HASHES, "git_revision": "abc", "cpu": "ours"},
}
ROW = RESULT | {"behaviour": HASHES[NAME], "revision": "abc", "hardware": "ours"}
STUDIES = """
development_seeds = [[0, 99]]
evaluation_seeds = [[200, 299]]
[studies.one]
question = "How often?"
device = "cpu"
hours = 0.1
seeds = [{seed}]
workcell = "ur5e_allegro"
[studies.one.commands]
"one/seen.json" = "python measure.py experiments/results/one/seen.json"
[tables.rates]
study = "one"
files = {{ seen = "one/seen.json" }}
columns = {{ "S.R." = "success_rate", lost = "failures.lost" }}
"""
WAIVER = '[[waivers]]\nstudy = "one"\nreason = "none"\nuntil = 2030-01-01\n'
SCRIPT = """
import pathlib, sys
with open("count", "a") as file:
    file.write("x")
pathlib.Path(sys.argv[1]).parent.mkdir(parents=True)
pathlib.Path(sys.argv[1]).write_text(pathlib.Path("result").read_text())
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout with one study, whose script writes the content of a file, and one table."""
    (tmp_path / FOLDER).mkdir()
    declare(tmp_path)
    (tmp_path / "measure.py").write_text(SCRIPT)
    (tmp_path / "result").write_text(json.dumps(RESULT))
    (tmp_path / "README.md").write_text("# Rates\n\n<!-- table: rates -->\n<!-- end -->\n")
    return tmp_path


def declare(root: Path, seed: int = 200, waivers: int = 0) -> None:
    (root / FOLDER / "studies.toml").write_text(STUDIES.format(seed=seed))
    (root / FOLDER / "waivers.toml").write_text(waivers * WAIVER or "waivers = []\n")


def problems(root: Path, today: datetime.date = NEVER) -> str:
    return "\n".join(Studies.load(root).problems(today))


def error_of(words: list[str], root: Path) -> str:
    with pytest.raises(SystemExit) as ended:
        main(words, root)
    return str(ended.value)


def test_the_documents_agree_with_their_files():
    assert problems(ROOT) == ""


def test_tables_of_rates_are_generated():
    """A table outside the markers has no interval and no deviation."""
    pattern = re.compile(r"^\|.*\d(?: ± \d| \[[+-]?\d).*$", re.MULTILINE)
    pages = {path: PLACE.sub("", text) for path, text in Studies.load(ROOT).pages.items()}
    assert {path.name: found for path, text in pages.items() if (found := pattern.findall(text))} == {}


def test_commands_of_studies_are_understood():
    for study in Studies.load(ROOT).studies.values():
        for file, text in study.commands.items():
            program, *words = shlex.split(text)
            assert (ROOT / words[0]).exists() if program == "python" else parse(words)
            assert Path(file).parts[0] in text, f"{text} does not write {file}"


def test_a_study_is_computed_once_and_its_table_written(checkout: Path, capsys: pytest.CaptureFixture[str]):
    assert "without 1 of 1 files" in problems(checkout)
    for _ in range(2):
        main([], checkout)
    assert (checkout / "count").read_text() == "x"
    assert (checkout / "README.md").read_text() == PAGE.format(rate="50.0 [40, 60]", lost=3)
    main(["--check"], checkout)
    main(["--list"], checkout)
    assert "current" in capsys.readouterr().out


def test_a_study_that_fails_ends_with_an_error(checkout: Path):
    (checkout / "result").unlink()
    assert error_of([], checkout).startswith("error: no result: one/seen.json")
    assert (checkout / "README.md").read_text() == PAGE.format(rate=DASH, lost=DASH)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"success_rate": 0.51}, "README.md differs from the files"),
        ({"circumstances": {"behaviour": {NAME: "other"}}}, "study 'one' is outdated"),
        ({"circumstances": {}}, "study 'one' is outdated"),
        ({"sessions": [RESULT["circumstances"], {"behaviour": {}}]}, "study 'one' is outdated"),
        ({"results": [ROW, ROW | {"behaviour": "other"}]}, "study 'one' is outdated"),
        ({"results": [ROW, ROW | {"revision": None}]}, "study 'one' is outdated"),
    ],
)
def test_another_number_or_behaviour_is_found(checkout: Path, change: dict, words: str):
    main([], checkout)
    (checkout / FOLDER / "results/one/seen.json").write_text(json.dumps(RESULT | change))
    assert words in error_of(["--check"], checkout)
    declare(checkout, waivers=1)
    assert "outdated" not in problems(checkout)
    assert "ended on 2030-01-01" in problems(checkout, datetime.date(2030, 1, 2))


def test_waivers_and_seeds_are_bounded(checkout: Path):
    main([], checkout)
    declare(checkout, waivers=6)
    assert "6 waivers; at most 5" in problems(checkout)
    assert "the waiver of 'one' is not needed" in problems(checkout)
    declare(checkout, seed=50)
    assert "uses seed 50" in problems(checkout)


def test_an_unknown_table_is_named(checkout: Path):
    (checkout / "README.md").write_text("<!-- table: rate -->\n<!-- end -->\n")
    assert "unknown table 'rate'" in error_of(["--check"], checkout)
