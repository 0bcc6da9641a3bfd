"""Numbers in documents are those of the files beside them, and their commands are such that exist."""

import json
import re
import shlex
from pathlib import Path

import pytest

from pixel2catch.cli.main import parse

ROOT = Path(__file__).parents[1]
COMPARISON = ROOT / "experiments" / "results" / "2026-11-21-comparison" / "report" / "table.json"


PAGES = (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"))
COMMANDS = [
    (page.name, line)
    for page in PAGES
    for line in re.findall(r"^(?:torchrun .* -m )?(pixel2catch .*)$", page.read_text("utf-8"), re.MULTILINE)
]


def cells() -> dict[str, list[str]]:
    """Cells of the README's comparison, by method."""
    rows = re.findall(
        r"^\| `(\w+)` \| (.+) \|$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    return {method: row.split(" | ") for method, row in rows}


def test_the_comparison_is_that_of_its_report():
    results = json.loads(COMPARISON.read_text())["results"]
    by_name = {(result["method"], result["objects"]): result for result in results}
    columns = [("tracking_rate", "seen"), ("tracking_rate", "unseen"), ("success_rate", "seen")]
    columns += [("success_rate", "unseen"), ("verified_hold_rate", "seen")]
    assert set(cells()) == {method for method, _ in by_name}
    for method, found in cells().items():
        rates = [by_name[method, objects][rate] for rate, objects in columns]
        assert found[:5] == [f"{100 * r['mean']:.1f} ± {100 * r['deviation']:.1f}" for r in rates]


def test_links_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_commands_are_understood(page: str, line: str):
    """Options and their kinds are right; what the commands do is tested where they are."""
    parse(shlex.split(line, comments=True)[1:])
