"""The report of a transfer matrix: rates of every engine, and throw by throw against home."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from math import comb, nan
from pathlib import Path

from pixel2catch import offline_page
from pixel2catch.circumstances import circumstances
from pixel2catch.evaluation.heat_map import heat_map
from pixel2catch.evaluation.metrics import Metrics, paired_difference
from pixel2catch.evaluation.report import RATES, Cells, csv_text, markdown, percent, write_files
from pixel2catch.evaluation.stress.measuring import Json, Result
from pixel2catch.evaluation.stress.report import REAL_ROBOT, compare_methods
from pixel2catch.evaluation.transfer.cells import PAIRED
from pixel2catch.files import json_text

REAL_ORDER = (
    f"The paper's real robot has {' > '.join(REAL_ROBOT)}, an S.R. of "
    f"{', '.join(f'{rate:g}' for rate in REAL_ROBOT.values())} % over 360 throws each. Kendall's tau is 1 "
    "for the same order, and the mean maximum rank violation, in points of the real robot's S.R., is 0. "
    "Pairs are settled whose 95 % intervals do not overlap: the order of others may be chance, and with so "
    "few methods tau is coarse. Equal rates stand in the real robot's order."
)


def make_table(results: Sequence[Result], metrics: Sequence[Metrics]) -> Json:
    """The whole report as plain data; the engine of the first result is home."""
    home = results[0].setting.axis.name
    texts = {_place(each): found["throws"] for each, found in zip(results, metrics, strict=True)}
    cells = []
    for each, found in zip(results, metrics, strict=True):
        policy, engine, label = place = _place(each)
        rates = {}
        for name, noted in PAIRED.items():
            rates[name] = {"rate": found[name], "interval": found[f"{name}_interval"]}
            if engine != home:
                rates[name] |= paired_difference(texts[policy, home, label][noted], texts[place][noted])
        cells.append(
            {
                "policy": policy,
                "method": each.policy.method,
                "engine": engine,
                "restitution": label,
                "throws": found["trials"],
                **rates,
                "failures": found["failures"],
                "max_penetration": found["max_penetration"],
            }
        )
    return {"home": home, "cells": cells, "orders": list(_orders(cells))}


def _orders(cells: Sequence[Json]) -> Iterator[Json]:
    """Of every engine and restitution the order of the methods, beside that of the real robot."""
    for engine, label in dict.fromkeys((cell["engine"], cell["restitution"]) for cell in cells):
        of_method: dict[str, list[Metrics]] = {}
        for cell in cells:
            if (cell["engine"], cell["restitution"]) == (engine, label):
                rate = {"trials": cell["throws"], "success_rate": cell["success_rate"]["rate"]}
                of_method.setdefault(cell["method"], []).append(rate)
        if order := compare_methods(of_method):
            yield {"engine": engine, "restitution": label, **asdict(order), "sentence": order.sentence()}


def write_report(out: Path, table: Json) -> None:
    """Write the files of the report, all or none."""
    image = picture(table)
    files = {
        "table.json": json_text(table),
        "table.csv": as_csv(table),
        "table.md": as_markdown(table),
        "heatmap.png": image,
        "page.html": as_page(table, image, circumstances()),
    }
    write_files(out, files)


def as_markdown(table: Json) -> str:
    """Rates in percent with their 95 % intervals, differences from home, and how throws failed."""
    lines = ["# Transfer"]
    for title, text, rows in _sections(table):
        lines += [f"## {title}", text, markdown(rows, num_text_columns=3)]
    return "\n\n".join(lines)


def as_page(table: Json, image: bytes, when: Json) -> str:
    """The same as one HTML page that opens offline, with the picture."""
    parts = [
        offline_page.picture(image, "png", "S.R. [%] and its difference from home in points"),
        *(offline_page.section(*words, offline_page.plain_table(rows)) for *words, rows in _sections(table)),
        offline_page.what_was_run(when),
    ]
    return offline_page.page("Transfer", parts)


def _sections(table: Json) -> Iterator[tuple[str, str, list[Cells]]]:
    """Title, text and rows of each part of the report."""
    rows = sorted(table["cells"], key=lambda cell: _order(table, cell))
    head = (
        f"{rows[0]['throws']} throws each, the same in all engines; home is {table['home']}. Rates in % with "
        "their 95 % interval; the difference of S.R. in points with its 95 % interval, the throws that were "
        "lost and won by it, and the p value of McNemar's exact test. Failures in % of the throws."
    )
    yield "Engine by engine", head, [_row(cell) for cell in rows]
    if table["orders"]:
        yield "Beside the real robot", REAL_ORDER, _order_rows(table)


def as_csv(table: Json) -> str:
    """One row for every cell and rate."""
    columns = ("policy", "engine", "restitution", "throws", "rate", "value", "low", "high")
    columns += ("lost", "won", "difference", "difference_low", "difference_high", "p_value")
    rows = []
    for cell in table["cells"]:
        for name in PAIRED:
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
    cells = [[found.get((*place, engine), {"rate": nan}) for engine in engines] for place in places]
    marks = [[_signed(cell.get("difference")) for cell in row] for row in cells]
    return heat_map(
        [[100.0 * cell["rate"] for cell in row] for row in cells],
        marks,
        [f"{policy}, restitution {label}" for policy, label in places],
        engines,
        [policy for policy, _ in places],
        f"S.R. [%]; difference from {table['home']}",
        digits=1,
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
    row |= {
        title: percent(cell[name]["rate"], cell[name]["interval"])
        for title, name in RATES.items()
        if name in cell
    }
    difference, counts, p = "home", "", ""
    if "lost" in success:
        low, high = (100.0 * bound for bound in success["difference_interval"])
        difference = f"{100.0 * success['difference']:+.1f} [{low:+.1f}, {high:+.1f}]"
        counts, p = f"{success['lost']}, {success['won']}", f"{success['p_value']:.2g}"
    row |= {"difference": difference, "lost, won": counts, "p": p}
    return row | {name.replace("_", " "): f"{100.0 * rate:.1f}" for name, rate in cell["failures"].items()}


def _order_rows(table: Json) -> list[Cells]:
    return [
        {
            "engine": order["engine"],
            "restitution": order["restitution"],
            "order of S.R.": " > ".join(order["simulated"]),
            "Kendall's tau": f"{order['tau']:.2f}",
            "rank violation": f"{order['rank_violation']:.1f}",
            "settled pairs": f"{order['num_settled']} of {comb(len(order['real']), 2)}",
        }
        for order in table["orders"]
    ]


def _signed(difference: float | None) -> str:
    return "" if difference is None else f"{100.0 * difference:+.1f}"
