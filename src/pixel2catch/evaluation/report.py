"""Reports of studies: rows as tables in Markdown, pictures, and JSON for programs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import json_text, read_json_object, write_atomically
from pixel2catch.reports import DASH, Cells, Section, as_markdown

Row = Mapping[str, Any]  #: A result as plain data.


def write_report(folder: Path, title: str, sections: Sequence[Section], data: Mapping[str, Any]) -> str:
    """Write a report: all of its files or none.

    Args:
        folder: Gets table.md, table.json and the pictures.
        title: Title of the study.
        sections: What people read.
        data: The rows behind it, by kind, for table.json.

    Returns:
        The names of the files.
    """
    files = {"table.md": as_markdown(title, sections), "table.json": json_text(data)}
    pictures = {name: content for each in sections for name, content in each.pictures.items()}
    write_files(folder, files | pictures)
    return ", ".join([*files, *pictures])


def table(rows: Sequence[Row], down: str, across: str, text: Callable[[Row], str]) -> list[Cells]:
    """Return a line for each value of one field, with a column for each value of another."""
    columns = dict.fromkeys((row[across] for row in rows), DASH)
    lines: dict[str, dict[str, str]] = {}
    for row in rows:
        lines.setdefault(row[down], {down: row[down], **columns})[row[across]] = text(row)
    return list(lines.values())


def percent(rate: float, interval: Sequence[float]) -> str:
    """Return a rate with its interval, in percent."""
    low, high = (100 * bound for bound in interval)
    return f"{100 * rate:.1f} [{low:.0f}, {high:.0f}]"


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


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write files by name, all or none.

    Raises:
        OSError: If they cannot be written; earlier files are then unchanged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    contents = {name: text.encode() if isinstance(text, str) else text for name, text in files.items()}
    write_atomically({folder / name: content for name, content in contents.items()})


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
