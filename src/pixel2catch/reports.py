"""Circumstances of a result, and reports: tables in Markdown and in the terminal, pictures beside them."""

import datetime
import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from pixel2catch.behaviour import HASHES

PACKAGES = ("pixel2catch", "torch", "mujoco", "mujoco-warp", "warp-lang", "numpy")
"""Packages whose versions a result can depend on."""

DASH = "\N{EN DASH}"  #: Text of a missing number.

Cells = Mapping[str, str]  #: A line of a table, by column; the first line of a table has all columns.


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a report."""

    title: str
    text: str = ""  #: What the table and the pictures show.
    rows: Sequence[Cells] = ()
    pictures: Mapping[str, bytes] = field(default_factory=dict)  #: PNG files by name.


def as_markdown(title: str, sections: Sequence[Section]) -> str:
    """Return a report as Markdown."""
    parts = [f"# {title}"]
    for each in sections:
        parts += [f"## {each.title}", each.text, *(f"![{each.title}]({name})" for name in each.pictures)]
        parts += [markdown(each.rows)] if each.rows else []
    return "\n\n".join(part.rstrip() for part in parts if part) + "\n"


def markdown(rows: Sequence[Cells]) -> str:
    """Return a table in Markdown; columns of numbers alone are aligned right."""
    columns = _columns(rows)
    lines = [[*columns], ["---:" if each else "---" for each in columns.values()]]
    lines += [[row.get(column, "") for column in columns] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def terminal_table(title: str, rows: Sequence[Cells]) -> Table:
    """Return a table for the terminal; columns of numbers alone are aligned right."""
    table, columns = Table(title=Text(title)), _columns(rows)
    for number, (column, is_number) in enumerate(columns.items()):
        table.add_column(Text(column), justify="right" if is_number else "left", no_wrap=not number)
    for row in rows:
        table.add_row(*(Text(row.get(column, "")) for column in columns))
    return table


def _columns(rows: Sequence[Cells]) -> dict[str, bool]:
    """Return the columns of a table, and whether all texts of each begin as numbers do."""
    texts = {column: [row.get(column, "") for row in rows] for column in (rows[0] if rows else ())}
    return {
        column: all(text in ("", DASH) or text[0] in "+-[0123456789" for text in each)
        for column, each in texts.items()
    }


def circumstances() -> dict[str, Any]:
    """Return the time, command, versions and machine of this process, and the hashes of behaviour."""
    import torch  # takes seconds

    cpu = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    return {
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": shlex.join(["pixel2catch", *sys.argv[1:]]),
        "git_revision": _git_revision(),
        "behaviour": HASHES,
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "platform": platform.platform(),
        "cpu": next((line.partition(": ")[2] for line in cpu if line.startswith("model name")), None),
        "cpu_cores": os.cpu_count(),
        "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
    }


def provenance(found: Mapping[str, Any], workcell: str) -> dict[str, str | None]:
    """Return what a row of a result records of its circumstances."""
    return {
        "revision": found.get("git_revision"),
        "hardware": ", ".join(found.get("gpus", ())) or found.get("cpu"),
        "behaviour": found.get("behaviour", {}).get(workcell),
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_revision() -> str | None:
    """Return the git revision of this package's source, with "+" after changes."""
    describe = ("describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+")
    command = ["git", "-C", str(Path(__file__).parent), *describe]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
