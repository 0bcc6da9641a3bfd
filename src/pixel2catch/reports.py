"""Circumstances of a result, and reports as one HTML page without references to other files or scripts."""

import base64
import datetime
import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

PACKAGES = ("pixel2catch", "torch", "mujoco", "mujoco-warp", "warp-lang", "numpy")
"""Packages whose versions a result can depend on."""

STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; color: #1c1c1c; margin: 2rem auto; padding: 0 1rem;
  max-width: 72rem }
h1 { font-size: 1.7rem; margin-bottom: .2rem }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .4rem }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem }
p { margin: .4rem 0; max-width: 60rem }
ul { margin: .3rem 0; padding-left: 1.2rem }
.scroll { overflow-x: auto }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th { text-align: left; vertical-align: bottom; border-bottom: 1.5px solid #1c1c1c }
td { vertical-align: top; border-bottom: 1px solid #e4e4e4 }
th, td { padding: .25rem 1.1rem .25rem 0 }
td:first-child { white-space: nowrap }
small { display: block; color: #6a6a6a; font-weight: 400 }
.good { color: #17703f } .weak { color: #9a5b00 } .unknown { color: #6a6a6a }
.BAD { color: #b3261e; font-weight: 600 }
.box { border-left: 4px solid; padding: .5rem .9rem; margin: .7rem 0; background: #f6f6f6 }
.box p { color: #1c1c1c }
.key span { display: inline-block; width: 1.6rem; height: 3px; margin: 0 .4rem .25rem 1.1rem }
figure { margin: .8rem 0; break-inside: avoid }
figcaption { font-weight: 600 }
img { width: 100%; display: block }
code { background: #f2f2f2; padding: .1rem .3rem; overflow-wrap: anywhere }
@page { size: A4; margin: 14mm }
@media print {
  body { margin: 0; max-width: none; font-size: 10px; print-color-adjust: exact }
  tr, .box { break-inside: avoid }
  h2, h3 { break-after: avoid }
  .scroll { overflow: visible }
  th, td { padding-right: .5rem }
}
"""
"""Look of the page, on a screen and on paper."""


class Cell(NamedTuple):
    """One entry of a table: its text, a verdict (a class of `STYLE`) for its colour, and a small note."""

    text: str
    verdict: str = ""
    note: str = ""


def page(title: str, parts: Iterable[str]) -> str:
    """Return a page with a title above its parts."""
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    body = "\n".join((element("h1", title), *parts))
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>{head}</head>\n<body>\n{body}\n</body>\n</html>\n'


def element(tag: str, text: str) -> str:
    """Return text in an element."""
    return f"<{tag}>{escape(text)}</{tag}>"


def section(title: str, text: str, *parts: str, tag: str = "h2") -> str:
    """Return parts under a heading and a text."""
    return "\n".join((element(tag, title), *([element("p", text)] if text else ()), *parts))


def listing(texts: Sequence[str]) -> str:
    """Return a list, or nothing if there are no texts."""
    return f"<ul>{''.join(element('li', text) for text in texts)}</ul>" if texts else ""


def box(text: str, verdict: str) -> str:
    """Return a box with a main result, in the colour of a verdict."""
    return f'<div class="box {verdict}">{element("p", text)}</div>'


def table(columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """Return a table."""
    head = "".join(element("th", column) for column in columns)
    body = ""
    for row in rows:
        cells = ""
        for cell in row:
            kind = f' class="{cell.verdict}"' if cell.verdict else ""
            note = element("small", cell.note) if cell.note else ""
            cells += f"<td{kind}>{escape(cell.text)}{note}</td>"
        body += f"<tr>{cells}</tr>\n"
    content = f"<table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table>"
    return f'<div class="scroll">{content}</div>'


def plain_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Return a table of texts by column; the first row has all columns."""
    columns = list(rows[0])
    return table(columns, [[Cell(row.get(column, "")) for column in columns] for row in rows])


def picture(data: bytes, kind: str, caption: str) -> str:
    """Return a picture of a kind, such as png, below its caption."""
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    caption = escape(caption)
    return f'<figure><figcaption>{caption}</figcaption><img alt="{caption}" src="{source}"></figure>'


def what_was_run(circumstances: Mapping[str, Any], *lines: str) -> str:
    """Return a section with the circumstances of a result and further lines."""
    command = f"<p>{element('code', circumstances['command'])}</p>"
    return section("What was run", "", command, listing([*circumstances_lines(circumstances), *lines]))


def circumstances_lines(circumstances: Mapping[str, Any]) -> list[str]:
    """Return the time, the revision, the machine and the versions as lines."""
    versions = ", ".join(f"{name} {version or '?'}" for name, version in circumstances["versions"].items())
    gpus = ", ".join(circumstances.get("gpus", ())) or "no GPU"
    where = f"{circumstances['platform']}, {circumstances['cpu_cores']} CPU cores, {gpus}"
    return [
        f"{circumstances['started']}; revision {circumstances['git_revision'] or 'unknown'}; {where}",
        f"Python {circumstances['python']}, {versions}",
    ]


def circumstances() -> dict[str, Any]:
    """Return the time, command, versions and machine of this process."""
    import torch  # takes seconds

    return {
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": shlex.join(["pixel2catch", *sys.argv[1:]]),
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "platform": platform.platform(),
        "cpu": _cpu_name(),
        "cpu_cores": os.cpu_count(),
        "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
    }


def _cpu_name() -> str | None:
    """Return the kernel's name of the first processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), None)


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
