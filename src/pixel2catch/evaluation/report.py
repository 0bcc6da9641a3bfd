"""Reports of studies: rows as tables in Markdown, pictures, and JSON for programs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pixel2catch.files import json_text, write_atomically
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


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write files by name, all or none.

    Raises:
        OSError: If they cannot be written; earlier files are then unchanged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    contents = {name: text.encode() if isinstance(text, str) else text for name, text in files.items()}
    write_atomically({folder / name: content for name, content in contents.items()})
