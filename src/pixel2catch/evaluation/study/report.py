"""The report of a study: tables, pictures, and one page with all of them."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

from pixel2catch.evaluation.study.aggregate import (
    Row,
    mean_and_deviation,
    object_rows,
    summary_rows,
    training_rows,
)
from pixel2catch.evaluation.study.curves import curves_csv, study_curves
from pixel2catch.evaluation.study.page import page
from pixel2catch.evaluation.study.plan import Plan, StudyFolder
from pixel2catch.evaluation.tables import CONTACT_RATES, MAIN_RATES
from pixel2catch.files import write_atomically
from pixel2catch.mdp.throws import ThrowCfg

Cells = Mapping[str, str]

DASH = "\N{EN DASH}"
"""What stands where there is no number."""


def write_report(folder: StudyFolder) -> None:
    """Write the report of what is there; what is missing is left out.

    Args:
        folder: The study.

    Raises:
        StudyError: If there is no study.
        OSError: If it cannot be written; a report that was there before is still whole.
    """
    plan = folder.plan()
    tables, files = _tables(folder, plan)
    files |= _pictures(folder, plan)
    files["README.md"] = page(plan, folder.sessions(), tables, files).encode()
    folder.report.mkdir(parents=True, exist_ok=True)
    write_atomically({folder.report / name: content for name, content in files.items()})


def rates_table(rows: Sequence[Row]) -> list[Cells]:
    """T.R. and S.R.: mean ± deviation over seeds, the interval over all trials, and the paper's numbers."""
    return [
        {
            "method": row["method"],
            "objects": row["objects"],
            "seeds": str(row["seeds"]),
            **{
                column: text
                for title, name in MAIN_RATES.items()
                for column, text in (
                    (f"{title} [%]", _spread(row[name])),
                    (f"{title}, 95 % interval", _interval(row[name])),
                    (f"{title}, paper", _spread((row["paper"] or {}).get(name), digits=2)),
                )
            },
        }
        for row in rows
    ]


def quality_table(rows: Sequence[Row]) -> list[Cells]:
    """Contact, verified holds and extremes."""
    return [
        {
            "method": row["method"],
            "objects": row["objects"],
            "trials": f"{row['trials']:,}",
            **{f"{title} [%]": _spread(row[name]) for title, name in CONTACT_RATES.items()},
            "largest joint speed [rad/s]": f"{row['max_joint_speed']:.2f}",
            "largest torque [% of limit]": f"{100 * row['max_torque_share']:.1f}",
            "deepest penetration [mm]": f"{1000 * row['max_penetration']:.1f}",
        }
        for row in rows
    ]


def trainings_table(rows: Sequence[Row]) -> list[Cells]:
    """Length and duration of the finished trainings of each method."""
    table = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        mean, deviation = mean_and_deviation([row["seconds"] / 60 for row in own])
        spread = DASH if deviation is None else f"{deviation:.1f}"
        table.append(
            {
                "method": method,
                "seeds": str(len(own)),
                "transitions of a seed": f"{max(row['transitions'] for row in own):,}",
                "wall-clock of a seed [min]": f"{mean:.1f} ± {spread}",
            }
        )
    return table


def by_object_table(rows: Sequence[Row]) -> list[Cells]:
    """S.R. [%] with its interval: objects down, methods across."""
    table: dict[str, dict[str, str]] = {}
    methods = dict.fromkeys((row["method"] for row in rows), DASH)
    for row in rows:
        cells = table.setdefault(row["object"], {"object": row["object"], "set": row["objects"], **methods})
        rate = row["success_rate"]
        cells[row["method"]] = f"{100 * rate['pooled']:.1f} {_interval(rate)}"
    return list(table.values())


def markdown(table: Sequence[Cells]) -> str:
    """A table in Markdown; numbers to the right."""
    if not table:
        return "Nothing has been finished yet.\n"
    columns = list(table[0])
    lines = [columns, [("---:" if i > 1 else "---") for i in range(len(columns))]]
    lines += [[row[column] for column in columns] for row in table]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def flat_csv(rows: Sequence[Row]) -> str:
    """Rows as CSV; what is nested becomes `outer_inner` columns, lists of seeds are left out."""
    flat = [_flattened(row) for row in rows]
    columns = list(dict.fromkeys(name for row in flat for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()


def _tables(folder: StudyFolder, plan: Plan) -> tuple[dict[str, str], dict[str, bytes]]:
    """The tables of the page by name, and the files."""
    summary, objects = list(summary_rows(folder, plan)), list(object_rows(folder, plan))
    trainings = list(training_rows(folder, plan))
    tables = {
        "rates": markdown(rates_table(summary)),
        "quality": markdown(quality_table(summary)),
        "trainings": markdown(trainings_table(trainings)),
        "by_object": markdown(by_object_table(objects)),
    }
    content = json.dumps({"results": summary, "objects": objects, "trainings": trainings}, indent=2)
    files = {
        "table.md": "\n".join((tables["rates"], tables["quality"], tables["trainings"])),
        "table.csv": flat_csv(summary),
        "table.json": content + "\n",
        "by_object.md": tables["by_object"],
        "by_object.csv": flat_csv(objects),
        "trainings.csv": flat_csv(trainings),
    }
    return tables, {name: text.encode() for name, text in files.items()}


def _pictures(folder: StudyFolder, plan: Plan) -> dict[str, bytes]:
    """The pictures that there is something to draw for, with the numbers of the curves."""
    from pixel2catch.evaluation.pictures import png
    from pixel2catch.evaluation.study.figures import curves_figure, objects_figure
    from pixel2catch.evaluation.study.throw_figure import throws_figure

    files = {"throws.png": png(throws_figure(ThrowCfg()))}
    if curves := study_curves(folder, plan):
        files |= {"curves.png": png(curves_figure(curves)), "curves.csv": curves_csv(curves).encode()}
    if objects := list(object_rows(folder, plan)):
        files |= {"objects.png": png(objects_figure(objects))}
    return files


def _spread(rate: Row | None, digits: int = 1) -> str:
    """Mean ± deviation in percent; a dash for what there is not."""
    if rate is None:
        return DASH
    deviation = DASH if rate["deviation"] is None else f"{100 * rate['deviation']:.{digits}f}"
    return f"{100 * rate['mean']:.{digits}f} ± {deviation}"


def _interval(rate: Row) -> str:
    low, high = rate["interval"]
    return f"[{100 * low:.1f}, {100 * high:.1f}]"


def _flattened(row: Row, prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            flat |= _flattened(value, f"{prefix}{name}_")
        elif name == "interval":
            flat |= {f"{prefix}low": value[0], f"{prefix}high": value[1]}
        elif name != "values" and value is not None:
            flat[prefix + name] = value
    return flat
