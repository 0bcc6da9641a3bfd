"""Text tables, and the logs of a robot controller and of a sender of commands that are such tables."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pixel2catch.errors import RecordingError
from pixel2catch.files import read_text, reading, shown
from pixel2catch.identification.joints import joints_of
from pixel2catch.identification.recording import Place, Recording, require_motion
from pixel2catch.robots.workcell import WorkcellSpec

MOST_NAMED = 30  #: Columns of a table that a message names.
MOST_TABLE, MOST_ROWS = 2**27, 2**21
"""Bytes and lines of a text table: an hour at 500 Hz. Source: ours."""

MEASURED_FILE = "rtde.csv"
"""Measurements: `timestamp, actual_q_0` … `actual_q_5`, perhaps `actual_qd_*`. Source: the names of RTDE."""

COMMAND_FILE = "commands.csv"
"""Commands: `t, q_0` … `q_5`, written by whoever sent them. RTDE's `target_q` is what the controller made of
them, with hardly any lag, and not the command."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A text table: cells become numbers when a column is asked for."""

    path: Path
    names: tuple[str, ...]  #: names of the columns
    lines: tuple[str, ...]  #: of the rows
    place: Place  #: what rows are called in messages: lines of the file, counted from 1

    def texts(self, name: str) -> list[str]:
        """The cells of a column.

        Raises:
            RecordingError: If there is no such column.
        """
        if name not in self.names:
            raise RecordingError(
                f"{self.path}: no column {name}; it has {', '.join(self.names[:MOST_NAMED])}. "
                "Record this column, or give it this name in the first line."
            )
        column = self.names.index(name)
        return [_cells(line)[column] for line in self.lines]

    def column(self, name: str) -> np.ndarray:
        """The numbers of a column.

        Raises:
            RecordingError: If there is no such column, or a cell is no number.
        """
        numbers = np.empty(len(self.lines))
        for i, cell in enumerate(self.texts(name)):
            try:
                numbers[i] = float(cell)
            except ValueError:
                where = f"{self.place.at(i)}, column {name}"
                raise RecordingError(
                    f"{where}: {shown(cell)} is no number; correct or cut this line."
                ) from None
        return numbers

    def columns(self, names: Iterable[str]) -> np.ndarray:
        """The numbers of several columns, shape (rows, columns); raises as `column` does."""
        return np.stack([self.column(name) for name in names], axis=-1)


def read_table(path: Path, names: tuple[str, ...] = ()) -> Table:
    """Read cells between commas, or spaces where no comma is; line 1 names the columns, unless names do.

    Raises:
        RecordingError: If the file cannot be read, is empty or too long, or a line has too few or too many
            cells.
    """
    with reading("table", path, "Record again, or cut it.", RecordingError):
        text = read_text(path, MOST_TABLE).strip()
        if text.count("\n") > MOST_ROWS:
            raise RecordingError(f"it has more than {MOST_ROWS:,} lines")
    lines = text.split("\n")
    first = 0 if names else 1
    if len(lines) <= first or not text:
        raise RecordingError(f"{path}: empty, there is no line of numbers; record again.")
    place = Place(source=str(path), row="line", first_row=1 + first)
    table = Table(path=path, names=names or tuple(_cells(lines[0])), lines=tuple(lines[first:]), place=place)
    for i, line in enumerate(table.lines):
        if (num_cells := len(_cells(line))) != len(table.names):
            raise RecordingError(
                f"{place.at(i)}: {num_cells} columns instead of {len(table.names)}; "
                "correct or cut this line (the last one may have been cut off while recording)."
            )
    return table


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split(",")] if "," in line else line.split()


def read_rtde(folder: Path, workcell: WorkcellSpec, *, is_partial: bool) -> Recording:
    """Two logs of the first arm. RTDE's currents are in ampere, its moments targets: there is no effort.

    A partial one has the joints that are in both.
    """
    arms = [group.name for group in workcell.groups if group.role == "arm"]
    if not arms:
        raise RecordingError(f"{folder}: logs of an arm; '{workcell.name}' has none, choose a --workcell.")
    joints = joints_of(workcell, arms[0])
    command, measured = read_table(folder / COMMAND_FILE), read_table(folder / MEASURED_FILE)
    numbers = list(range(len(joints)))
    both = [i for i in numbers if f"q_{i}" in command.names and f"actual_q_{i}" in measured.names]
    numbers = both if is_partial and both else numbers
    joints = tuple(joints[i] for i in numbers)
    t_cmd, q_cmd = command.column("t"), command.columns(f"q_{i}" for i in numbers)
    require_motion(command.place, joints, t_cmd, q_cmd, workcell=workcell)
    t_meas, q = measured.column("timestamp"), measured.columns(f"actual_q_{i}" for i in numbers)
    has_speed = any(name.startswith("actual_qd_") for name in measured.names)
    qd = measured.columns(f"actual_qd_{i}" for i in numbers) if has_speed else None
    require_motion(measured.place, joints, t_meas, q, *([] if qd is None else [qd]), workcell=workcell)
    motion = {"t_cmd": t_cmd, "q_cmd": q_cmd, "t_meas": t_meas, "q": q, "qd": qd}
    return Recording(name=str(folder), workcell=workcell, joints=joints, **motion)
