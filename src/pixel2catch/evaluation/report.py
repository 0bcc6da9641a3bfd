"""Results for people: tables for the terminal and for files, and pictures, beside the paper's numbers."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from pixel2catch.evaluation.metrics import Metrics
from pixel2catch.files import write_atomically
from pixel2catch.scene.objects import SEEN, UNSEEN

if TYPE_CHECKING:  # it takes a second, and most results are no pictures
    from matplotlib.figure import Figure

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
"""The paper's rates, in the order of `PAPER`, and the metrics that they are."""

CONTACT_RATES = {"palm contact": "palm_contact_rate", "verified hold": "verified_hold_rate"}
"""Rates that ask for contact, which the paper does not have."""

RATES = MAIN_RATES | CONTACT_RATES  #: Columns of the tables and the metrics that they show.
DPI = 160  #: Pixels of an inch of a picture.
Cells = Mapping[str, str]  #: A row of a table, by column.


def result_tables(results: Mapping[str, Metrics], method: str) -> Iterator[Table]:
    """Tables of one or several sets of objects by name; with the rates of every object where it is one."""
    title = f"{method}: % of trials [95 % interval]; paper: mean ± deviation over 3 seeds"
    yield terminal_table(title, results_rows(results, method))
    if len(results) == 1:
        yield terminal_table("by object", objects_rows(*results.values()))
    yield terminal_table("failures and contact", quality_rows(results))


def results_rows(results: Mapping[str, Metrics], method: str) -> list[Cells]:
    """Rates of sets of objects, each beside the paper's where it has them."""
    rows = []
    for name, result in results.items():
        rows.append({"objects": name, **_cells(result)})
        if paper := PAPER.get((method, tuple(result["objects_thrown"]))):
            texts = (f"{mean:.2f} ± {deviation:.2f}" for mean, deviation in paper)
            rows.append({"objects": "  paper", **dict(zip(MAIN_RATES, texts, strict=True))})
    return rows


def objects_rows(result: Metrics) -> list[Cells]:
    """Rates object by object."""
    return [{"object": name, **_cells(each)} for name, each in result["objects"].items()]


def quality_rows(results: Mapping[str, Metrics]) -> list[Cells]:
    """Failure modes, quality of contacts and holds, one column per set of objects."""
    columns = {name: _quality(result) for name, result in results.items()}
    return [
        {"": row, **{name: column[row] for name, column in columns.items()}}
        for row in next(iter(columns.values()))
    ]


def terminal_table(title: str, rows: Sequence[Cells]) -> Table:
    """A table for the terminal; numbers, right of the first column, are aligned to the right."""
    table, columns = Table(title=title), list(rows[0] if rows else ())
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left", no_wrap=not number)
    for row in rows:
        table.add_row(*(row.get(column, "") for column in columns))
    return table


def _cells(rates: Metrics) -> dict[str, str]:
    texts = {title: percent(rates[name], rates[f"{name}_interval"]) for title, name in RATES.items()}
    # A narrow terminal then breaks before the interval, not within it.
    shown = {title: text.replace(", ", "\N{EN DASH}") for title, text in texts.items()}
    return {"trials": f"{rates['trials']}", **shown}


def _quality(result: Metrics) -> dict[str, str]:
    def scaled(name: str, factor: float, unit: str, digits: int = 1) -> str:
        if result.get(name) is None:  # or it was not counted yet when that was written
            return "-"
        return f"{round(factor * result[name], digits) + 0.0:.{digits}f} {unit}"  # + 0.0: no -0.0

    return {
        **{f"failed: {name}".replace("_", " "): f"{100 * v:.1f} %" for name, v in result["failures"].items()},
        "robot touched the table": scaled("table_contact_rate", 100, "%"),
        "robot touched itself": scaled("self_contact_rate", 100, "%"),
        "  control steps of that, a trial": scaled("self_contact_steps", 1, "steps"),
        "robots touched each other": scaled("robot_contact_rate", 100, "%"),
        "height of the first contact": scaled("contact_height", 100, "cm"),
        "mean penetration": scaled("mean_penetration", 1000, "mm"),
        "largest penetration": scaled("max_penetration", 1000, "mm"),
        "largest penetration of the table": scaled("max_table_penetration", 1000, "mm"),
        "largest arm joint speed": scaled("max_joint_speed", 1, "rad/s"),
        "largest torque, share of limit": scaled("max_torque_share", 100, "%"),
        "mean arm joint speed in the hold": scaled("hold_speed", 1, "rad/s", 3),
        "mean hand torque in the hold, share of limit": scaled("hold_torque_share", 100, "%"),
        "mean number of palms in reach in the hold": scaled("hold_palms", 1, "", 2),
        "peak deceleration of the object, median": scaled("peak_deceleration", 1, "m/s²"),
    }


def percent(rate: float, interval: Sequence[float], digits: int = 0) -> str:
    """A rate with its interval, in percent."""
    low, high = (100 * bound for bound in interval)
    return f"{100 * rate:.1f} [{low:.{digits}f}, {high:.{digits}f}]"


def markdown(table: Sequence[Cells], num_text_columns: int = 2) -> str:
    """A table in Markdown; numbers, right of the text, are aligned to the right."""
    if not table:
        return "Nothing has been finished yet.\n"
    columns = list(table[0])
    lines = [columns, [("---" if i < num_text_columns else "---:") for i in range(len(columns))]]
    lines += [[row[column] for column in columns] for row in table]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def latex(table: Sequence[Cells], num_text_columns: int = 2) -> str:
    """A table in LaTeX, with the rules of the package booktabs."""
    if not table:
        return "% Nothing has been finished yet.\n"
    columns = list(table[0])
    kinds = "l" * num_text_columns + "r" * (len(columns) - num_text_columns)
    head, *rows = (
        " & ".join(_escaped(text) for text in line) + r" \\"
        for line in (columns, *([row[column] for column in columns] for row in table))
    )
    lines = [rf"\begin{{tabular}}{{{kinds}}}", r"\toprule", head, r"\midrule", *rows, r"\bottomrule"]
    return "\n".join([*lines, r"\end{tabular}"]) + "\n"


def _escaped(text: str) -> str:
    """Text of a Markdown cell with what LaTeX writes differently."""
    plain = text.replace("**", "").replace("\\*", "*")
    for character in "%_&#":
        plain = plain.replace(character, f"\\{character}")
    return plain.replace("±", r"$\pm$").replace("\N{EN DASH}", "--").replace("°", r"$^\circ$")


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Rows as CSV, under a line of names."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    return text.getvalue()


def differences(before: Mapping[str, Any], now: Mapping[str, Any], where: str) -> str:
    """What is otherwise now: names with both values; empty if nothing is."""
    names = [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]
    return "; ".join(f"{name}: {before.get(name)} {where}, {now.get(name)} now" for name in names)


def png(figure: "Figure") -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write the files of a report by name, all or none.

    Raises:
        OSError: If it cannot be written; a report that was there before is still whole.
    """
    folder.mkdir(parents=True, exist_ok=True)
    contents = {name: text.encode() if isinstance(text, str) else text for name, text in files.items()}
    write_atomically({folder / name: content for name, content in contents.items()})
