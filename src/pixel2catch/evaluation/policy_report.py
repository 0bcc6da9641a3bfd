"""Rows and reports of stress and transfer studies."""

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from statistics import fmean

from pixel2catch.evaluation.grid import Json, read_row
from pixel2catch.evaluation.metrics import paired_difference
from pixel2catch.evaluation.policy_cells import EVENTS, PolicyEntry, cell_file
from pixel2catch.evaluation.report import RATES, Row, difference, percent, table
from pixel2catch.evaluation.stress import Setting, is_trained_on
from pixel2catch.reports import Cells, Section

KEPT = (
    *("trials", *EVENTS, *(f"{name}_interval" for name in EVENTS), "failures", "max_penetration"),
    *(f"closed_loop_hold_rate{kind}" for kind in ("", "_interval", "_trials")),
    *("reachable_rate", "reachable", "seed", "revision", "hardware", "behaviour"),
)
"""Metrics in the rows."""

UNTRAINED = "†"  #: Mark of a setting that a policy was not trained on.


def result_rows(
    policies: Sequence[PolicyEntry], settings: Sequence[Setting], out: Path, home_of: Callable[[Setting], str]
) -> list[Row]:
    """Return a row for each result that there is in the folder of a study, setting by setting.

    `home_of` returns the name of the setting that another one is compared with: `success_rate_change` and its
    like have the difference from it over the same throws.
    """
    rows, found = list[Row](), dict[tuple[str, str], Json]()
    for setting, policy in product(settings, policies):
        if content := read_row(cell_file(out, policy, setting)):
            found[policy.name, setting.name] = content["metrics"]
    for setting, policy in product(settings, policies):
        metrics, home, level = found.get((policy.name, setting.name)), home_of(setting), setting.level
        if metrics is None:
            continue
        row = {
            "setting": setting.name,
            "axis": setting.axis.name,
            "level": level.label,
            "unit": setting.axis.unit,
            "title": setting.title,
            "source": level.source,
            "method": policy.method,
            "task": policy.task.name,
            "policy": policy.name,
            "is_trained_on": is_trained_on(policy.task, level.change),
            **{name: metrics[name] for name in KEPT if name in metrics},
        }
        throws, at_home = (one.get("throws") for one in (metrics, found.get((policy.name, home), {})))
        if home != setting.name and throws and at_home:
            for name, event in EVENTS.items():
                row[f"{name}_change"] = paired_difference(at_home[event], throws[event])
        rows.append(row)
    return rows


def stress_sections(rows: Sequence[Row]) -> list[Section]:
    """Return the parts of the report: S.R. by setting and policy, and the sources."""
    text = (
        f"S.R. [%], {rows[0]['trials']} throws each, 95 % interval. {UNTRAINED}: the policy was not trained "
        "on that disturbance."
    )
    lines = table(rows, "title", "policy", _percent)
    policies = dict.fromkeys(row["policy"] for row in rows)
    means = {name: fmean(r["success_rate"] for r in rows if r["policy"] == name) for name in policies}
    lines.append({"title": "mean over settings", **{n: f"{100 * mean:.1f}" for n, mean in means.items()}})
    sources = {row["title"]: row["source"] for row in rows}
    return [
        Section(title="Success rates", text=text, rows=lines),
        Section(title="Sources", rows=[{"title": name, "source": each} for name, each in sources.items()]),
    ]


def transfer_sections(rows: Sequence[Row]) -> list[Section]:
    """Return the parts of the report: rates and differences from home."""
    text = (
        f"{rows[0]['trials']} throws each, the same in all engines; home is {rows[0]['axis']}. Rates in % "
        "with their 95 % interval; difference of S.R. from home in points with its 95 % interval, number of "
        "throws lost and won by it, and p value of McNemar's exact test. Failures in % of the throws."
    )
    lines = [_transfer_line(row) for row in sorted(rows, key=lambda row: row["policy"])]
    return [Section(title="Engines", text=text, rows=lines)]


def _percent(row: Row) -> str:
    mark = "" if row["is_trained_on"] else f" {UNTRAINED}"
    return percent(row["success_rate"], row["success_rate_interval"]) + mark


def _transfer_line(row: Row) -> Cells:
    line = {"policy": row["policy"], "restitution": row["level"], "engine": row["axis"]}
    line |= {
        title: percent(row[name], row[f"{name}_interval"]) for title, name in RATES.items() if name in row
    }
    line |= difference_cells(row.get("success_rate_change"))
    return line | {name.replace("_", " "): f"{100.0 * rate:.1f}" for name, rate in row["failures"].items()}


def difference_cells(change: Row | None) -> Cells:
    """Return the cells of a `paired_difference`, in points; of None those of home."""
    if not change:
        return {"difference": "home", "lost, won": "", "p": ""}
    return {
        "difference": difference(change),
        "lost, won": f"{change['lost']}, {change['won']}",
        "p": f"{change['p_value']:.2g}",
    }
