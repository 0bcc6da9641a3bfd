"""Reports of studies, and tables of evaluations beside the numbers of the paper."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from pixel2catch.evaluation.metrics import Metrics
from pixel2catch.files import json_text, write_atomically
from pixel2catch.reports import DASH, Cells, Section, as_markdown, terminal_table
from pixel2catch.scene.objects import SEEN, UNSEEN

Row = Mapping[str, Any]  #: A result as plain data.

PAPER = {
    ("without_pf", SEEN): ((12.13, 1.27), (8.93, 1.04)),
    ("without_pf", UNSEEN): ((12.11, 1.9), (7.89, 1.46)),
    ("only_wh", SEEN): ((8.03, 0.6), (5.53, 0.51)),
    ("only_wh", UNSEEN): ((6.11, 0.35), (4.00, 0.17)),
    ("only_center", SEEN): ((87.07, 1.62), (81.27, 0.76)),
    ("only_center", UNSEEN): ((87.5, 1.53), (80.72, 0.38)),
    ("single_agent", SEEN): ((78.2, 1.32), (63.5, 0.85)),
    ("single_agent", UNSEEN): ((75.83, 2.00), (65.44, 2.25)),
    ("proposed", SEEN): ((89.97, 0.21), (84.13, 0.50)),
    ("proposed", UNSEEN): ((89.28, 0.79), (84.83, 1.17)),
}
"""T.R. and S.R. [%] by method and objects: mean and deviation over three seeds. Source: paper, Sec. V."""

MAIN_RATES = {"T.R.": "tracking_rate", "S.R.": "success_rate"}
"""Rates of the paper, in the order of `PAPER`, with the names of their metrics."""

CONTACT_RATES = {
    "palm contact": "palm_contact_rate",
    "verified hold": "verified_hold_rate",
    "closed-loop hold": "closed_loop_hold_rate",
}
"""Rates that need contact; the paper has none of them. Objects lack the last one."""

RATES = MAIN_RATES | CONTACT_RATES  #: Columns of the tables and the metrics that they show.


def write_report(folder: Path, title: str, sections: Sequence[Section], data: Mapping[str, Any]) -> str:
    """Write table.md, its pictures, and table.json with the rows behind them; return the files' names."""
    files = {"table.md": as_markdown(title, sections), "table.json": json_text(data)}
    pictures = {name: content for each in sections for name, content in each.pictures.items()}
    write_atomically({folder / name: content for name, content in (files | pictures).items()})
    return ", ".join([*files, *pictures])


def table(rows: Sequence[Row], down: str, across: str, text: Callable[[Row], str]) -> list[Cells]:
    """Return a line for each value of one field, with a column for each value of another."""
    columns = dict.fromkeys((row[across] for row in rows), DASH)
    lines: dict[str, dict[str, str]] = {}
    for row in rows:
        lines.setdefault(row[down], {down: row[down], **columns})[row[across]] = text(row)
    return list(lines.values())


def percent(rates: Row, name: str) -> str:
    """Return a rate with its interval, in percent, by the name of `metrics.rate`."""
    low, high = (100 * bound for bound in rates[f"{name}_interval"])
    return f"{100 * rates[name]:.1f} [{low:.0f}, {high:.0f}]"


def spread(rate: Row | None, digits: int = 1) -> str:
    """Return mean ± deviation in percent; a dash for a missing number."""
    if rate is None:
        return DASH
    deviation = DASH if rate["deviation"] is None else f"{100 * rate['deviation']:.{digits}f}"
    return f"{100 * rate['mean']:.{digits}f} ± {deviation}"


def difference(change: Row) -> str:
    """Return the difference of two rates with its interval, in points."""
    low, high = (100 * bound for bound in change["difference_interval"])
    return f"{100 * change['difference']:+.1f} [{low:+.1f}, {high:+.1f}]"


def difference_cells(change: Row | None) -> dict[str, str]:
    """Return the cells of a `paired_difference`, in points; of None those of home."""
    if not change:
        return {"difference": "home", "lost, won": "", "p": ""}
    return {
        "difference": difference(change),
        "lost, won": f"{change['lost']}, {change['won']}",
        "p": f"{change['p_value']:.2g}",
    }


def result_tables(results: Mapping[str, Metrics], method: str) -> Iterator[Table]:
    """Yield the tables of one or several sets of objects, by name; of one set also those of each object."""
    rows = list[Cells]()
    for name, result in results.items():
        rows.append({"objects": name, **_cells(result)})
        if result["reachable_rate"] < 1.0:
            own = _cells(result["reachable"]) if "reachable" in result else {"trials": "0"}
            rows.append({"objects": "  reachable", **own})
        if paper := PAPER.get((method, tuple(result["objects_thrown"]))):
            texts = (f"{mean:.2f} ± {deviation:.2f}" for mean, deviation in paper)
            rows.append({"objects": "  paper", **dict(zip(MAIN_RATES, texts, strict=True))})
    yield terminal_table(f"{method}: % of trials [95 % interval]; paper: mean ± deviation over 3 seeds", rows)
    if len(results) == 1:
        objects = next(iter(results.values()))["objects"]
        yield terminal_table(
            "by object", [{"object": name, **_cells(each)} for name, each in objects.items()]
        )
    columns = {name: _quality(result) for name, result in results.items()}
    quality = [
        {"": row} | {name: each[row] for name, each in columns.items()}
        for row in next(iter(columns.values()))
    ]
    yield terminal_table("failures and contact", quality)


def _cells(rates: Metrics) -> dict[str, str]:
    texts = {title: percent(rates, name) for title, name in RATES.items() if name in rates}
    # Without a space in the interval, a narrow terminal breaks the line before it.
    shown = {title: text.replace(", ", "-") for title, text in texts.items()}
    return {"trials": f"{rates['trials']}", **shown}


def _quality(result: Metrics) -> dict[str, str]:
    def scaled(name: str, factor: float, unit: str, digits: int = 1) -> str:
        if result.get(name) is None:  # no such event
            return "-"
        return f"{round(factor * result[name], digits) + 0.0:.{digits}f} {unit}"  # + 0.0: no -0.0

    torques = (result.get("hold_torque") or {}).items()
    share, finger = max(((share, name) for name, share in torques), default=(0.0, ""))
    return {
        **{f"failed: {name}".replace("_", " "): f"{100 * v:.1f} %" for name, v in result["failures"].items()},
        "robot touched the table": scaled("table_contact_rate", 100, "%"),
        "robot touched itself": scaled("self_contact_rate", 100, "%"),
        "robots touched each other": scaled("robot_contact_rate", 100, "%"),
        "mean penetration": scaled("mean_penetration", 1000, "mm"),
        "largest penetration": scaled("max_penetration", 1000, "mm"),
        "largest arm joint speed": scaled("max_joint_speed", 1, "rad/s"),
        "largest torque, share of limit": scaled("max_torque_share", 100, "%"),
        "arm joint at its torque limit, a throw": scaled("arm_limit_time", 1, "s", 2),
        "finger torque in the hold, share of limit": f"{100 * share:.1f} % ({finger})" if finger else "-",
        "largest force on the object in a throw, median": scaled("median_object_force", 1, "N"),
        "largest force on the object": scaled("max_object_force", 1, "N"),
        "mean arm joint speed in the hold": scaled("hold_speed", 1, "rad/s", 3),
        "mean number of palms in reach in the hold": scaled("hold_palms", 1, "", 2),
    }
