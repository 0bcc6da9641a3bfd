"""Compute the studies behind the documents, and write the tables that are made of their files.

`experiments/studies.toml` declares studies and tables, `experiments/waivers.toml` what may be shown although
it was measured under another behaviour of the simulation. A document has a table between
`<!-- table: NAME -->` and `<!-- end -->`.
"""

import argparse
import datetime
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

import pixel2catch as p2c
from pixel2catch.behaviour import HASHES
from pixel2catch.errors import StudyError, UnknownNameError
from pixel2catch.evaluation.grid import read_row
from pixel2catch.evaluation.report import Row, difference, percent, spread
from pixel2catch.files import decoded, read_text, reading, write_atomically
from pixel2catch.reports import DASH, Cells, markdown, provenance, terminal_table

ROOT = Path(__file__).parents[2]  #: Root of the checkout.
FOLDER = Path("experiments")  #: Folder of the declarations, in the root.
MOST_WAIVERS = 5  #: Largest number of waivers. Source: ours.
PAGES = ("*.md", "docs/**/*.md", "companions/*/README.md")  #: Documents that may have tables.
PLACE = re.compile(r"(<!-- table: (\S+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Study:
    """A question, and the commands whose files answer it."""

    question: str
    device: str  #: Where it is computed: cpu or cuda.
    hours: float  #: Time that it takes there [h].
    seeds: tuple[int, ...]  #: First seeds of its throws; none if it has no throws.
    commands: dict[str, str]  #: Commands by the file in `results` that each writes.
    workcell: str = ""  #: Work cell whose behaviour decides it; empty if no robot is simulated.


@dataclass(frozen=True, kw_only=True)
class DocumentTable:
    """A table of a document. A column is a key of the rows, with conditions: `success_rate, objects=seen`."""

    study: str
    files: dict[str, str]  #: Files in `results` by their name in the table.
    columns: dict[str, str]  #: Keys of the columns, by title.
    rows: str = "results"  #: Key of the list of rows in a file, or `*`; a file without it is one row.
    down: str = "file"  #: Key whose values are the lines. `file`: the name of the file in the table.
    first: str = ""  #: Title of the first column.
    names: dict[str, str] = field(default_factory=dict)  #: Lines by value: only these, so named.


@dataclass(frozen=True, kw_only=True)
class Waiver:
    """A study whose files may be shown although they were measured under another behaviour, or under none."""

    study: str
    reason: str
    until: datetime.date  #: Last day.


@dataclass(frozen=True, kw_only=True)
class Studies:
    """What `studies.toml` and `waivers.toml` declare."""

    root: Path  #: Root of the checkout.
    development_seeds: tuple[tuple[int, int], ...]  #: First and last seeds that development has used.
    evaluation_seeds: tuple[tuple[int, int], ...]  #: Those for results.
    studies: dict[str, Study]
    tables: dict[str, DocumentTable]
    waivers: tuple[Waiver, ...]

    @classmethod
    def load(cls, root: Path) -> "Studies":
        """Read the declarations; raise StudyError if they are damaged or absent."""
        content: dict[str, Any] = {"root": str(root)}
        for name in ("studies", "waivers"):
            file = root / FOLDER / f"{name}.toml"
            with reading(name, file, "Correct the file.", StudyError):
                content |= tomllib.loads(read_text(file))
        return decoded(cls, content)

    def study(self, name: str) -> Study:
        """Return a study by name; raise UnknownNameError if there is none."""
        if name not in self.studies:
            raise UnknownNameError("study", name, self.studies)
        return self.studies[name]

    def file(self, name: str) -> Path:
        """Return the path of a result file."""
        return self.root / FOLDER / "results" / name

    @cached_property
    def pages(self) -> dict[Path, str]:
        """The texts of the documents, with all tables written anew."""
        paths = [path for pattern in PAGES for path in sorted(self.root.glob(pattern))]
        return {path: PLACE.sub(self._replaced, path.read_text("utf-8")) for path in paths}

    def state(self, name: str) -> str:
        """Return whether the files of a study are there, with their origin, and of the present behaviour."""
        study, waived = self.studies[name], {each.study: each.until for each in self.waivers}
        missing = [file for file in study.commands if not self.file(file).exists()]
        if missing:
            return f"without {len(missing)} of {len(study.commands)} files"
        if all(is_current(self._content(file), study.workcell) for file in study.commands):
            return "current"
        return f"waived until {waived[name]}" if name in waived else "outdated"

    def problems(self, today: datetime.date) -> Iterator[str]:
        """Yield what is wrong with tables, behaviour, waivers and seeds."""
        yield from (*self._table_problems(), *self._waiver_problems(today), *self._seed_problems())

    def _table_problems(self) -> Iterator[str]:
        for path, text in self.pages.items():
            if text != path.read_text("utf-8"):
                yield f"{path.relative_to(self.root)} differs from the files; run 'make results'"
        shown = {name for text in self.pages.values() for _, name, *_ in PLACE.findall(text)}
        yield from (f"no document has the table '{name}'" for name in self.tables if name not in shown)
        for name in sorted({table.study for table in self.tables.values()}):
            if (state := self.state(name)) == "outdated" or state.startswith("without"):
                again = "delete its files and run" if state == "outdated" else "run"
                yield f"study '{name}' is {state}; {again} 'make results STUDIES={name}'"

    def _waiver_problems(self, today: datetime.date) -> Iterator[str]:
        if len(self.waivers) > MOST_WAIVERS:
            yield f"there are {len(self.waivers)} waivers; at most {MOST_WAIVERS} are allowed: measure again"
        for each in self.waivers:
            self.study(each.study)  # it exists
            if self.state(each.study) == "current":
                yield f"the waiver of '{each.study}' is not needed; delete it"
            if each.until < today:
                yield f"the waiver of '{each.study}' ended on {each.until}; measure again"

    def _seed_problems(self) -> Iterator[str]:
        waived = {each.study for each in self.waivers}
        for name, study in self.studies.items():
            for seed in () if name in waived else study.seeds:
                if not _is_in(seed, self.evaluation_seeds) or _is_in(seed, self.development_seeds):
                    yield f"study '{name}' uses seed {seed}, which is not one of `evaluation_seeds`"

    def cells(self, table: DocumentTable) -> list[Cells]:
        """Return a table's lines; a file or a value that is missing is a dash."""
        known = table.names or (table.files if table.down == "file" else ())
        lines: dict[str, list[Row]] = {name: [] for name in known}
        for name, file in table.files.items():
            for row in rows_of(self._content(file), table.rows):
                value = str(_at({"file": name, **row}, table.down))
                if not table.names or value in table.names:
                    lines.setdefault(value, []).append(row)
        return [
            {table.first: table.names.get(name, name)} | {t: _text(rows, c) for t, c in table.columns.items()}
            for name, rows in lines.items()
        ]

    def _content(self, file: str) -> Row:
        return read_row(self.file(file)) or {}

    def _replaced(self, place: re.Match[str]) -> str:
        begin, name, _, end = place.groups()
        if name not in self.tables:
            raise UnknownNameError("table", name, self.tables)
        return f"{begin}{markdown(self.cells(self.tables[name]))}{end}"


def rows_of(content: Row, key: str = "results") -> list[Row]:
    """Return the rows of a result: a list in it, all parts with their names (`*`), or itself."""
    if key == "*":
        return [{"name": name, **each} for name, each in content.items() if isinstance(each, Mapping)]
    return content[key] if isinstance(content.get(key), list) else [content]


def is_current(content: Row, workcell: str) -> bool:
    """Return whether each row of a result has its revision, its hardware, and the present behaviour."""
    workcell = content.get("workcell", workcell)
    sessions = content.get("sessions") or [content.get("circumstances") or {}]
    whole = [provenance(each, workcell) for each in sessions]
    found = [each for row in rows_of(content) for each in ([row] if "behaviour" in row else whole)]
    current = {*HASHES.values()} if workcell else {None}
    return all(each["revision"] and each["hardware"] and each["behaviour"] in current for each in found)


def _is_in(seed: int, ranges: tuple[tuple[int, int], ...]) -> bool:
    return any(first <= seed <= last for first, last in ranges)


def _at(row: Row, key: str) -> Any:
    """Return the value at a dotted key, or nothing."""
    value: Any = row
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _text(rows: list[Row], column: str) -> str:
    """Return the text of a value: a rate with its interval, mean and deviation, a difference, a number."""
    key, *conditions = column.split(", ")
    wanted = dict(each.split("=") for each in conditions)
    for row in rows:
        if all(str(_at(row, name)) == value for name, value in wanted.items()):
            value, interval = _at(row, key), _at(row, f"{key}_interval")
            if interval is not None:
                return percent({key: value, f"{key}_interval": interval}, key)
            if isinstance(value, list):  # mean and deviation
                return " ± ".join(f"{each:.1f}" for each in value)
            if isinstance(value, Mapping):
                return spread(value) if "deviation" in value else difference(value)
            return f"{value:.3g}" if isinstance(value, float) else DASH if value is None else str(value)
    return DASH


def main(words: list[str] | None = None, root: Path = ROOT) -> None:
    """Compute missing studies and write the tables; or list the studies, or check the documents."""
    parser = argparse.ArgumentParser(
        description="Compute missing studies of the documents, and write their tables. What has a file is "
        "not computed again: delete the file to measure again. Studies for a GPU are computed where one is."
    )
    parser.add_argument("studies", nargs="*", help="names of studies; default: all")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--list", action="store_true", help="only show each study with its state")
    mode.add_argument("--check", action="store_true", help="only compare the documents with the files")
    args = parser.parse_args(words)
    try:
        declared = Studies.load(root)
        chosen = {name: declared.study(name) for name in args.studies or declared.studies}
        if args.list:
            rows = [
                {"study": name, "state": declared.state(name), "device": each.device}
                | {"hours": f"{each.hours:g}", "question": each.question}
                for name, each in chosen.items()
            ]
            Console(width=150).print(terminal_table("studies", rows))
        elif args.check:
            if problems := [*declared.problems(datetime.datetime.now(datetime.UTC).date())]:
                raise StudyError("\n".join(problems))
            print(f"{len(declared.tables)} tables agree with their files")
        else:
            failed = [file for name in chosen for file in compute_missing(declared, name)]
            write_atomically({path: text.encode() for path, text in Studies.load(root).pages.items()})
            if failed:
                raise StudyError(f"no result: {', '.join(failed)}; the other files were computed.")
    except p2c.Pixel2CatchError as error:
        sys.exit(f"error: {error}")


def compute_missing(declared: Studies, name: str) -> Iterator[str]:
    """Run the commands of a study whose files are missing; yield the files that they did not write."""
    study = declared.study(name)
    missing = {file: text for file, text in study.commands.items() if not declared.file(file).exists()}
    if missing and study.device == "cuda" and not torch.cuda.is_available():
        print(f"study '{name}' needs a GPU: run 'make results STUDIES={name}' on a machine with one")
        return
    for file, text in missing.items():
        print(f"{name}: {text}", flush=True)
        program, *options = shlex.split(text)
        start = [] if program == "python" else ["-m", program]
        ended = subprocess.run([sys.executable, *start, *options], cwd=declared.root)
        if ended.returncode or not declared.file(file).exists():
            yield file


if __name__ == "__main__":
    main()
