"""The report of a stress suite: `table.json`, `table.csv`, `table.md` and `heatmap.png`."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

from pixel2catch.envs.tasks import find_task
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.evaluation.stress.cells import Cell, Json
from pixel2catch.evaluation.stress.heatmap import UNTRAINED, heatmap
from pixel2catch.evaluation.stress.order import REAL_ROBOT, compare_orders
from pixel2catch.evaluation.stress.suite import REALITY
from pixel2catch.evaluation.stress.trained import is_trained_on
from pixel2catch.files import write_atomically

SHOWN = ("tracking_rate", "success_rate", "verified_hold_rate")
"""Rates of a cell that the tables keep."""


def make_table(cells: Sequence[Cell], results: Sequence[Json]) -> Json:
    """The whole report as plain data.

    Args:
        cells: The cells, setting by setting, each with all policies.
        results: What `run_cells` returned for them.
    """
    policies = {
        cell.contestant.name: {"method": cell.contestant.method, "task": cell.contestant.task}
        for cell in cells
    }
    settings: dict[str, Json] = {}
    for cell, result in zip(cells, results, strict=True):
        level, axis = cell.setting.level, cell.setting.axis
        row = {"axis": axis.name, "unit": axis.unit, "label": level.label, "source": level.source}
        row |= {"title": cell.setting.title, "rates": {}}
        is_trained = is_trained_on(find_task(cell.contestant.task), level.change)
        rates = _kept(result["metrics"]) | {"is_trained_on": is_trained}
        settings.setdefault(cell.setting.name, row)["rates"][cell.contestant.name] = rates
    means = {
        name: fmean(row["rates"][name]["success_rate"] for row in settings.values()) for name in policies
    }
    return {
        "policies": policies,
        "settings": settings,
        "mean": means,
        "reality": _reality(policies, settings),
    }


def write_report(out: Path, table: Json) -> None:
    """Write the four files of the report, all or none."""
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(
        {
            out / "table.json": (json.dumps(table, indent=2) + "\n").encode(),
            out / "table.csv": as_csv(table).encode(),
            out / "table.md": (as_markdown(table) + _sources(table)).encode(),
            out / "heatmap.png": heatmap(table),
        }
    )


def as_csv(table: Json) -> str:
    """One row for every cell."""
    buffer = io.StringIO()
    writer: Any = csv.writer(buffer, lineterminator="\n")
    place = ("setting", "axis", "level", "unit", "policy", "method", "is_trained_on", "trials")
    writer.writerow((*place, *_csv_rates()))
    for name, row in table["settings"].items():
        for policy, rates in row["rates"].items():
            method = table["policies"][policy]["method"]
            values = [value for rate in SHOWN for value in (rates[rate], *rates[f"{rate}_interval"])]
            place = (name, row["axis"], row["label"], row["unit"], policy, method)
            place += (str(rates["is_trained_on"]).lower(), rates["trials"])
            writer.writerow((*place, *(f"{value:.5f}" for value in values)))
    return buffer.getvalue()


def as_markdown(table: Json) -> str:
    """S.R. in percent with its 95 % interval, settings by policies; then the orders of the methods.

    What a policy was not trained on is marked.
    """
    names = list(table["policies"])
    lines = [f"| setting | {' | '.join(names)} |", f"| --- |{' --- |' * len(names)}"]
    for row in table["settings"].values():
        cells = [_percent(row["rates"][name]) for name in names]
        lines.append(f"| {row['title']} | {' | '.join(cells)} |")
    means = [f"{100 * table['mean'][name]:.1f}" for name in names]
    lines.append(f"| **mean over settings** | {' | '.join(means)} |")
    trials = next(iter(next(iter(table["settings"].values()))["rates"].values()))["trials"]
    marked = rf"\{UNTRAINED}: the policy was not trained on that disturbance."
    head = ["# Stress suite", "", f"S.R. [%], {trials} throws each, 95 % interval. {marked}", ""]
    return "\n".join([*head, *lines, "", table["reality"]["sentence"], ""])


def _sources(table: Json) -> str:
    """Where the numbers of every setting come from."""
    lines = [f"- {row['title']}: {row['source']}\n" for row in table["settings"].values()]
    return "\n## Where the numbers come from\n\n" + "".join(lines)


def _csv_rates() -> list[str]:
    return [column for name in SHOWN for column in (name, f"{name}_low", f"{name}_high")]


def _kept(metrics: Json) -> Json:
    """The part of a cell's metrics that the tables keep."""
    intervals = [f"{name}_interval" for name in SHOWN]
    return {name: metrics[name] for name in ("trials", *SHOWN, *intervals)}


def _percent(rates: Json) -> str:
    low, high = (100 * bound for bound in rates["success_rate_interval"])
    mark = "" if rates["is_trained_on"] else rf" \{UNTRAINED}"
    return f"{100 * rates['success_rate']:.1f} [{low:.0f}, {high:.0f}]{mark}"


def _reality(policies: Json, settings: Json) -> Json:
    """The order of the methods in the setting that is closest to reality, beside the real robot's."""
    rows = [row for row in settings.values() if row["label"] == REALITY]
    if not rows:
        return {"sentence": f"The setting '{REALITY}' was not asked for: no order to compare."}
    by_method: dict[str, list[Json]] = {}
    for name, rates in rows[0]["rates"].items():
        by_method.setdefault(policies[name]["method"], []).append(rates)
    order = compare_orders(
        {method: [each["success_rate"] for each in several] for method, several in by_method.items()},
        {method: _pooled_interval(several) for method, several in by_method.items()},
    )
    if order is None:
        return {"sentence": "Fewer than two methods that the real robot tried: no order to compare."}
    real = {method: REAL_ROBOT[method] for method in order.real}
    return {**asdict(order), "real_success_percent": real, "sentence": order.sentence()}


def _pooled_interval(several: Sequence[Json]) -> tuple[float, float]:
    """The interval of all throws at all policies of a method."""
    successes = sum(round(each["success_rate"] * each["trials"]) for each in several)
    return wilson_interval(successes, sum(each["trials"] for each in several))
