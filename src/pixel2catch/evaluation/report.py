"""Reports of studies: rows as tables in Markdown, HTML, CSV and JSON, with pictures."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from pixel2catch import reports
from pixel2catch.errors import InvalidValueError
from pixel2catch.files import json_text, read_json_object, write_atomically

if TYPE_CHECKING:  # importing it takes a second
    from matplotlib.figure import Figure

Row = Mapping[str, Any]  #: A result as plain data.
Cells = Mapping[str, str]  #: A line of a table, by column.

DASH = "\N{EN DASH}"  #: Text of a missing number.
DPI = 110  #: Pixels of an inch of a picture.


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a report."""

    title: str
    text: str = ""  #: What the table and the picture show.
    rows: Sequence[Cells] = ()
    figure: "Figure | None" = None
    file: str = ""  #: Name of the picture's file.


def write_report(
    folder: Path, title: str, sections: Sequence[Section], data: Mapping[str, Sequence[Row]]
) -> str:
    """Write a report: all of its files or none.

    Args:
        folder: Gets table.md, page.html, table.json, a CSV file for each kind of row, and the pictures.
        title: Title of the study.
        sections: What people read.
        data: The rows behind it, by kind; those of `results` go into table.csv.

    Returns:
        The names of the files.
    """
    pictures = {each.file: png(each.figure) for each in sections if each.figure}
    parts = [
        reports.section(
            each.title,
            each.text,
            *([reports.picture(pictures[each.file], "png", each.title)] if each.figure else ()),
            *([reports.plain_table(each.rows)] if each.rows else ()),
        )
        for each in sections
    ]
    files: dict[str, str | bytes] = {
        "table.md": as_markdown(title, sections),
        "page.html": reports.page(title, [*parts, reports.what_was_run(reports.circumstances())]),
        "table.json": json_text(data),
    }
    for kind, rows in data.items():
        files["table.csv" if kind == "results" else f"{kind}.csv"] = as_csv(rows)
    write_files(folder, files | pictures)
    return ", ".join([*files, *pictures])


def as_markdown(title: str, sections: Sequence[Section]) -> str:
    """Return a report as Markdown."""
    parts = [f"# {title}"]
    for each in sections:
        parts += [f"## {each.title}", each.text]
        parts += [f"![{each.title}]({each.file})"] if each.figure else []
        parts += [markdown(each.rows)] if each.rows else []
    return "\n\n".join(part.rstrip() for part in parts if part) + "\n"


def table(rows: Sequence[Row], by: tuple[str, str], text: Callable[[Row], str]) -> list[Cells]:
    """Return a line for each value of the first field, with a column for each value of the second."""
    down, across = by
    columns = dict.fromkeys((row[across] for row in rows), DASH)
    lines: dict[str, dict[str, str]] = {}
    for row in rows:
        lines.setdefault(row[down], {down: row[down], **columns})[row[across]] = text(row)
    return list(lines.values())


def percent(rate: float, interval: Sequence[float], digits: int = 0) -> str:
    """Return a rate with its interval, in percent."""
    low, high = (100 * bound for bound in interval)
    return f"{100 * rate:.1f} [{low:.{digits}f}, {high:.{digits}f}]"


def markdown(rows: Sequence[Cells], num_text_columns: int | None = None) -> str:
    """Return a table in Markdown; columns behind those of text, or of numbers alone, are aligned right."""
    columns = list(rows[0])
    is_text = [any(not _is_number(row[column]) for row in rows) for column in columns]
    if num_text_columns is not None:
        is_text = [number < num_text_columns for number in range(len(columns))]
    lines = [columns, ["---" if each else "---:" for each in is_text]]
    lines += [[row[column] for column in columns] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def terminal_table(title: str, rows: Sequence[Cells]) -> Table:
    """Return a table for the terminal; columns behind the first are aligned right."""
    table, columns = Table(title=title), list(rows[0] if rows else ())
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left", no_wrap=not number)
    for row in rows:
        table.add_row(*(row.get(column, "") for column in columns))
    return table


def as_csv(rows: Sequence[Row]) -> str:
    """Return rows as CSV: nested values as columns `outer_inner`, intervals as `_low` and `_high`."""
    flat = [_flat(row) for row in rows]
    columns = list(dict.fromkeys(name for row in flat for name in row))
    text = io.StringIO()
    lines = [[row.get(name, "") for name in columns] for row in flat]
    csv.writer(text, lineterminator="\n").writerows([columns, *lines])
    return text.getvalue()


def read_rows(file: Path) -> list[Row]:
    """Return the results in the `table.json` of a study, or in the JSON file of an evaluation or rehearsal.

    Files of earlier versions are read, too: those of a stress suite have `settings`, of a transfer `cells`.

    Raises:
        InvalidValueError: If the file holds no results.
    """
    content = read_json_object(file)
    if "results" in content:
        return content["results"]
    if "settings" in content:
        return [
            {name: row[name] for name in ("title", "axis", "unit", "label")}
            | {"setting": setting, "policy": policy, **content["policies"][policy], **rates}
            for setting, row in content["settings"].items()
            for policy, rates in row["rates"].items()
        ]
    if "cells" in content:
        return [_without_nesting(cell) for cell in content["cells"]]
    if "success_rate" not in content:
        raise InvalidValueError(f"'{file}' holds no results; name a table.json or the report of a rehearsal.")
    return [content]


def png(figure: "Figure") -> bytes:
    """Return the figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write files by name, all or none.

    Raises:
        OSError: If they cannot be written; earlier files are then unchanged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    contents = {name: text.encode() if isinstance(text, str) else text for name, text in files.items()}
    write_atomically({folder / name: content for name, content in contents.items()})


def _is_number(text: str) -> bool:
    return text in ("", DASH) or text[0] in "+-[0123456789"


def _flat(row: Row, prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}_")
        elif name == "interval" or name.endswith("_interval"):
            stem = prefix + name.removesuffix("interval")
            flat |= {f"{stem}low": value[0], f"{stem}high": value[1]}
        elif (value is not None and not isinstance(value, Sequence)) or isinstance(value, str):
            flat[prefix + name] = value
    return flat


def _without_nesting(cell: Row) -> Row:
    """The cell of an earlier transfer, with each rate and its interval as fields of the row."""
    row: dict[str, Any] = {}
    for name, value in cell.items():
        if isinstance(value, Mapping) and "rate" in value:
            change = {key: value[key] for key in value if key not in ("rate", "interval")}
            row |= {name: value["rate"], f"{name}_interval": value["interval"]}
            row |= {f"{name}_change": change} if change else {}
        else:
            row[name] = value
    return row
