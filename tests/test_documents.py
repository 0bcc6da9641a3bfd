"""Numbers in documents are those of the files beside them."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMPARISON = ROOT / "experiments" / "results" / "2026-11-21-comparison" / "report" / "table.json"


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
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")):
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
