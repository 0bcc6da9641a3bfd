"""Metrics of a training, a row for each update: console, CSV, TensorBoard, Weights & Biases."""

import csv
import importlib
import io
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from torch.utils.tensorboard import SummaryWriter

from pixel2catch.errors import CheckpointError, InvalidValueError
from pixel2catch.files import MOST_WEIGHTS, as_json, read_text, reading, write_atomically
from pixel2catch.installation import needs_extra
from pixel2catch.learning.config import TrainCfg
from pixel2catch.progress import ProgressBar

METRICS_FILE = "metrics.csv"
WANDB_FILE = "wandb.id"  #: Identifier of the run of Weights & Biases, for --resume.
Row = dict[str, int | float]  #: Metrics of one update by name; `transitions` is the abscissa.


class TrainingLog:
    """A bar or lines, CSV and TensorBoard; a full disk is reported and does not end the training."""

    def __init__(
        self, cfg: TrainCfg, folder: Path, transitions: int, console: Console, run: Any = None
    ) -> None:
        """Start after some transitions, with a run of Weights & Biases; a quiet console writes nothing."""
        self._console = console
        self._bar = ProgressBar(
            "training", cfg.transitions, done=transitions, console=console, line_seconds=cfg.report_seconds
        )
        self._sinks: dict[str, Callable[[Row], object]] = {}
        self._closing: dict[str, Callable[[], None]] = {}
        if console.quiet:
            return
        # TensorBoard hides later points of older event files.
        events = SummaryWriter(str(folder), purge_step=transitions or None)
        table = CsvLog(folder / METRICS_FILE, transitions)
        self._sinks["metrics"], self._closing["metrics"] = table.add, table.write
        self._sinks["TensorBoard events"] = lambda row: [
            events.add_scalar(name, value, int(row["transitions"])) for name, value in row.items()
        ]
        self._closing["TensorBoard events"] = events.close
        if run:
            self._sinks["metrics to Weights & Biases"] = run.log
            self._closing["the run of Weights & Biases"] = run.finish

    def __enter__(self) -> "TrainingLog":
        self._bar.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        for what, close in self._closing.items():
            self.attempt(what, close)
        self._bar.__exit__()

    def write(self, row: Row) -> None:
        """Show and write a row of metrics."""
        self._bar.show(row["transitions"], f"{row['transitions'] / 1e6:.2f} M transitions · {describe(row)}")
        for what, write in self._sinks.items():
            self.attempt(what, partial(write, row))

    def checkpoint(self, save: Callable[[], None]) -> None:
        """Write the table of metrics and a checkpoint."""
        self.attempt("metrics", self._closing.get("metrics", lambda: None))
        self.attempt("checkpoint", save)

    def attempt(self, what: str, write: Callable[[], object]) -> None:
        """Write something; if that fails, print a warning and go on."""
        try:
            write()
        except OSError as error:
            self.say(f"warning: could not write {what} ({error}); training goes on")

    def say(self, text: str) -> None:
        self._console.print(text, markup=False, soft_wrap=True)


def describe(row: Row) -> str:
    """Return the main metrics in one line: speed, rates and mean rewards."""
    parts = [f"{row['transitions_per_second'] / 1e3:.1f} k/s"]
    for name, value in row.items():
        if name.endswith("_rate"):
            shown = "-" if value != value else f"{100 * value:.1f} %"  # NaN: no episode has ended yet
            parts.append(f"{name.removesuffix('_rate')} {shown}")
        elif name.startswith("reward/"):
            parts.append(f"reward {name.removeprefix('reward/')} {value:+.4f}")
    return " · ".join(parts)


def wandb_package() -> Any:
    """Return the package of Weights & Biases, which is optional."""
    with needs_extra("wandb", "--wandb needs wandb", InvalidValueError):
        return importlib.import_module("wandb")


def start_wandb(project: str, folder: Path, config: Mapping[str, Any]) -> Any:
    """Start or continue a run of Weights & Biases with the folder's name; leave nothing if it fails."""
    wandb, file = wandb_package(), folder / WANDB_FILE
    number = file.read_text(encoding="utf-8") if file.exists() else None
    named = {"project": project, "name": folder.name, "dir": folder, "config": as_json(config), "id": number}
    try:
        run = wandb.init(**named, resume="allow")
    except (wandb.Error, ValueError) as error:  # the latter for a setting in the environment
        if not number:
            shutil.rmtree(folder / "wandb", ignore_errors=True)
        raise InvalidValueError(
            f"Weights & Biases does not begin a run ({error}); log in by 'wandb login', or set "
            "WANDB_MODE=offline."
        ) from error
    write_atomically({file: run.id})
    run.define_metric("*", step_metric="transitions")
    return run


class CsvLog:
    """A CSV file with a row for each update, written with every checkpoint: `--resume` goes on from there."""

    def __init__(self, path: Path, transitions: int = 0) -> None:
        """Keep the rows of the file up to `transitions`; later ones are repeated."""
        self._path = path
        with reading("metrics", path, "Remove this file; the training goes on without it.", CheckpointError):
            self._rows = [row for row in read_rows(path) if float(row["transitions"]) <= transitions]

    def add(self, row: Row) -> None:
        """Add a row, which `write` writes."""
        self._rows.append(
            {name: f"{value:.6g}" for name, value in row.items()} | {"transitions": str(row["transitions"])}
        )

    def write(self) -> None:
        text = io.StringIO()
        columns = dict.fromkeys(name for row in self._rows for name in row)
        writer = csv.DictWriter(text, [*columns], restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        write_atomically({self._path: text.getvalue()})


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a file of metrics; none if there is no file."""
    if not path.exists():
        return []
    names, *rows = (line.split(",") for line in read_text(path, MOST_WEIGHTS).splitlines())
    return [dict(zip(names, row, strict=True)) for row in rows]
