"""The report of a comparison: tables, pictures, and one page with all of them."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from pixel2catch.evaluation.comparison.plan import ComparisonFolder, Plan
from pixel2catch.evaluation.comparison.summary import (
    Row,
    all_curves,
    curves_csv,
    mean_and_deviation,
    object_rows,
    summary_rows,
    training_rows,
)
from pixel2catch.evaluation.report import (
    CONTACT_RATES,
    MAIN_RATES,
    Cells,
    csv_text,
    latex,
    markdown,
    percent,
    png,
    write_files,
)
from pixel2catch.files import json_text
from pixel2catch.offline_page import circumstances_lines

DASH = "\N{EN DASH}"  #: What stands where there is no number.

PICTURES = {
    "curves.png": (
        "Learning curves",
        "Rates in training against transitions: the policy is stochastic and all noise is on, so that they "
        "lie below those of the tables. Line: mean over the seeds; shaded: one standard deviation. Each "
        "point is the rate of all episodes that ended in a bin of transitions.",
    ),
    "objects.png": (
        "Success by object",
        "S.R. of the deterministic policies over the throws of all seeds, with 95 % Wilson intervals.",
    ),
}
"""Title and caption of every picture."""

RATES_NOTE = (
    "T.R.: the palm within 8 cm of the object once; S.R.: for 20 control steps in a row. Mean ± sample "
    "standard deviation over the seeds (no deviation of one seed); the 95 % Wilson intervals are over the "
    "trials of all seeds, and do not know that seeds differ. Paper: mean ± deviation over 3 seeds. The "
    "paper's unseen objects are not published; ours are stand-ins."
)
QUALITY_NOTE = (
    "Verified hold: after the success the policy stops, two parts of the hand touch the object for 1 s, and "
    "the hold survives half a second of shaking. Speed, torque and penetration are the largest of all throws."
)
TRAININGS_NOTE = "Trainings that run side by side on one device slow each other down."


def write_report(folder: ComparisonFolder) -> None:
    """Write the report of what is there; what is missing is left out.

    Raises:
        StudyError: If there is no study.
        OSError: If it cannot be written; a report that was there before is still whole.
    """
    plan = folder.plan()
    tables, files = _tables(folder, plan)
    files |= _pictures(folder, plan)
    files["README.md"] = _page(plan, folder.sessions(), tables, files)
    write_files(folder.report, files)


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
        cells[row["method"]] = percent(rate["pooled"], rate["interval"], digits=1)
    return list(table.values())


def flat_csv(rows: Sequence[Row]) -> str:
    """Rows as CSV; what is nested becomes `outer_inner` columns, lists of seeds are left out."""
    flat = [_flattened(row) for row in rows]
    columns = list(dict.fromkeys(name for row in flat for name in row))
    return csv_text(columns, [[row.get(name, "") for name in columns] for row in flat])


def _tables(folder: ComparisonFolder, plan: Plan) -> tuple[dict[str, str], dict[str, str | bytes]]:
    summary, objects = list(summary_rows(folder, plan)), list(object_rows(folder, plan))
    trainings = list(training_rows(folder, plan))
    rates = rates_table(summary)
    tables = {
        "rates": markdown(rates),
        "quality": markdown(quality_table(summary)),
        "trainings": markdown(trainings_table(trainings)),
        "by_object": markdown(by_object_table(objects)),
    }
    content = json_text({"results": summary, "objects": objects, "trainings": trainings})
    return tables, {
        "table.md": "\n".join((tables["rates"], tables["quality"], tables["trainings"])),
        "table.tex": latex(rates),
        "table.csv": flat_csv(summary),
        "table.json": content,
        "by_object.md": tables["by_object"],
        "by_object.csv": flat_csv(objects),
        "trainings.csv": flat_csv(trainings),
    }


def _pictures(folder: ComparisonFolder, plan: Plan) -> dict[str, str | bytes]:
    """The pictures that there is something to draw for, with the numbers of the curves."""
    from pixel2catch.evaluation.comparison.figures import curves_figure, objects_figure

    files: dict[str, str | bytes] = {}
    if curves := all_curves(folder, plan):
        files |= {"curves.png": png(curves_figure(curves)), "curves.csv": curves_csv(curves)}
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


def _page(
    plan: Plan, sessions: Sequence[Mapping[str, Any]], tables: Mapping[str, str], files: Collection[str]
) -> str:
    """The page, with the tables in Markdown by name, and the pictures that are among the files."""
    pictures = [
        f"## {title}\n\n![{title}]({name})\n\n{caption}\n"
        for name, (title, caption) in PICTURES.items()
        if name in files
    ]
    configuration = [{"name": name, "value": f"{value}"} for name, value in plan.configuration.items()]
    parts = [
        "# Study\n",
        f"Methods: {', '.join(plan.methods)}. Seeds of each: {plan.seeds}. "
        "This page is written by `pixel2catch reproduce`.\n",
        f"## Results\n\n{tables['rates']}\n{RATES_NOTE}\n",
        f"{tables['quality']}\n{QUALITY_NOTE}\n",
        *pictures,
        f"## S.R. by object\n\n{tables['by_object']}",
        f"## Trainings\n\n{tables['trainings']}\n{TRAININGS_NOTE}\n",
        f"## What was run\n\n{_sessions(sessions)}",
        f"## Configuration\n\n{markdown(configuration)}",
    ]
    return "\n".join(parts)


def _sessions(sessions: Sequence[Mapping[str, Any]]) -> str:
    lines = [(f"`{session['command']}`", *circumstances_lines(session)) for session in sessions]
    return "".join(f"- {command}\n  - {where}\n  - {versions}\n" for command, where, versions in lines)
