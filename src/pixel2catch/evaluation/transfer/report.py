"""The report of a transfer matrix: rates of every engine, and throw by throw against home."""

from collections.abc import Sequence
from pathlib import Path

from pixel2catch.evaluation.heat_map import heat_map
from pixel2catch.evaluation.metrics import paired_difference
from pixel2catch.evaluation.report import Cells, csv_text, markdown, percent, write_files
from pixel2catch.evaluation.stress.measuring import Json, Result
from pixel2catch.files import json_text

RATES = {
    "T.R.": ("tracking_rate", "is_tracked"),
    "S.R.": ("success_rate", "is_success"),
    "verified hold": ("verified_hold_rate", "is_verified"),
}
"""Rates of the tables, and what is noted of every throw for them."""


def make_table(results: Sequence[Result], contents: Sequence[Json]) -> Json:
    """The whole report as plain data; the engine of the first result is home."""
    home = results[0].setting.axis.name
    texts = {
        _place(each): content["metrics"]["throws"] for each, content in zip(results, contents, strict=True)
    }
    cells = []
    for each, content in zip(results, contents, strict=True):
        policy, engine, label = place = _place(each)
        found, rates = content["metrics"], {}
        for name, noted in RATES.values():
            rates[name] = {"rate": found[name], "interval": found[f"{name}_interval"]}
            if engine != home:
                rates[name] |= paired_difference(texts[policy, home, label][noted], texts[place][noted])
        cells.append(
            {
                "policy": policy,
                "engine": engine,
                "restitution": label,
                "throws": found["trials"],
                **rates,
                "failures": found["failures"],
                "max_penetration": found["max_penetration"],
            }
        )
    return {"home": home, "cells": cells}


def write_report(out: Path, table: Json) -> None:
    """Write the files of the report, all or none."""
    files = {
        "table.json": json_text(table),
        "table.csv": as_csv(table),
        "table.md": as_markdown(table),
        "heatmap.png": picture(table),
    }
    write_files(out, files)


def as_markdown(table: Json) -> str:
    """Rates in percent with their 95 % intervals, differences from home, and how throws failed."""
    rows = sorted(table["cells"], key=lambda cell: _order(table, cell))
    head = (
        f"{rows[0]['throws']} throws each, the same in all engines; home is {table['home']}. Rates in % with "
        "their 95 % interval; the difference of S.R. in points with its 95 % interval, the throws that were "
        "lost and won by it, and the p value of McNemar's exact test. Failures in % of the throws."
    )
    return "\n".join(
        ["# Transfer", "", head, "", markdown([_row(cell) for cell in rows], num_text_columns=3)]
    )


def as_csv(table: Json) -> str:
    """One row for every cell and rate."""
    columns = ("policy", "engine", "restitution", "throws", "rate", "value", "low", "high")
    columns += ("lost", "won", "difference", "difference_low", "difference_high", "p_value")
    rows = []
    for cell in table["cells"]:
        for name, _ in RATES.values():
            rate = cell[name]
            place = (*(cell[key] for key in columns[:4]), name)
            low, high = rate.get("difference_interval", ("", ""))
            paired = (*(rate.get(key, "") for key in columns[8:11]), low, high, rate.get("p_value", ""))
            rows.append((*place, rate["rate"], *rate["interval"], *paired))
    return csv_text(columns, rows)


def picture(table: Json) -> bytes:
    """S.R. in the cells, policies and restitutions by engines, with the difference from home; a PNG file."""
    engines = list(dict.fromkeys(cell["engine"] for cell in table["cells"]))
    found = {(c["policy"], c["restitution"], c["engine"]): c["success_rate"] for c in table["cells"]}
    places = list(dict.fromkeys((policy, label) for policy, label, _ in found))
    places.sort(key=lambda place: [each["policy"] for each in table["cells"]].index(place[0]))
    marks = [[_signed(found[(*place, engine)].get("difference")) for engine in engines] for place in places]
    return heat_map(
        [[100.0 * found[(*place, engine)]["rate"] for engine in engines] for place in places],
        marks,
        [f"{policy}, restitution {label}" for policy, label in places],
        engines,
        [policy for policy, _ in places],
        f"S.R. [%]; difference from {table['home']}",
    )


def _place(result: Result) -> tuple[str, str, str]:
    return result.policy.name, result.setting.axis.name, result.setting.level.label


def _order(table: Json, cell: Json) -> tuple[int, int]:
    policies = [each["policy"] for each in table["cells"]]
    labels = [each["restitution"] for each in table["cells"]]
    return policies.index(cell["policy"]), labels.index(cell["restitution"])


def _row(cell: Json) -> Cells:
    success = cell["success_rate"]
    row = {name: cell[name] for name in ("policy", "restitution", "engine")}
    row |= {title: percent(cell[name]["rate"], cell[name]["interval"]) for title, (name, _) in RATES.items()}
    difference, counts, p = "home", "", ""
    if "lost" in success:
        low, high = (100.0 * bound for bound in success["difference_interval"])
        difference = f"{100.0 * success['difference']:+.1f} [{low:+.1f}, {high:+.1f}]"
        counts, p = f"{success['lost']}, {success['won']}", f"{success['p_value']:.2g}"
    row |= {"difference": difference, "lost, won": counts, "p": p}
    return row | {name.replace("_", " "): f"{100.0 * rate:.1f}" for name, rate in cell["failures"].items()}


def _signed(difference: float | None) -> str:
    return "" if difference is None else f"{100.0 * difference:+.1f}"
