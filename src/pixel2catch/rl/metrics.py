"""Metrics of a training: one row per update, as CSV and for TensorBoard."""

import csv
import io
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from pixel2catch.files import write_atomically

METRICS_FILE = "metrics.csv"
Row = dict[str, int | float]
"""Metrics of one update by name; `transitions` is the abscissa."""


class CsvLog:
    """A CSV file that grows by a row an update.

    Rows that could not be written (full disk) are kept and written with a later one.
    """

    def __init__(self, path: Path, transitions: int = 0) -> None:
        """Open the file.

        Args:
            path: The file. Rows that it holds are kept up to `transitions`: what came later is repeated.
            transitions: Progress from which the training goes on.
        """
        self._path = path
        self._rows = [row for row in _read_rows(path) if float(row["transitions"]) <= transitions]
        self._columns: list[str] = []
        self._num_written = -1

    def write(self, row: Row) -> None:
        """Append a row; a column that is new makes the file be written anew.

        Raises:
            OSError: The row could not be written; it is not lost, and the file is intact.
        """
        self._rows.append(
            {name: f"{value:.6g}" for name, value in row.items()} | {"transitions": str(row["transitions"])}
        )
        columns = list(dict.fromkeys(name for row in (self._rows[0], self._rows[-1]) for name in row))
        if columns != self._columns or self._num_written < 0:
            text = ",".join(columns) + "\n" + _format(self._rows, columns)
            write_atomically({self._path: text.encode()})
        else:
            _append(self._path, _format(self._rows[self._num_written :], columns).encode())
        self._columns, self._num_written = columns, len(self._rows)

    def close(self) -> None:
        """Nothing to do: no file stays open."""


class TensorBoardLog:
    """The same rows for TensorBoard, over transitions."""

    def __init__(self, folder: Path, transitions: int = 0) -> None:
        """Open a new event file; what older files say after `transitions` is hidden."""
        self._writer = SummaryWriter(str(folder), purge_step=transitions or None)

    def write(self, row: Row) -> None:
        """Add a row."""
        for name, value in row.items():
            self._writer.add_scalar(name, value, int(row["transitions"]))

    def close(self) -> None:
        """Flush and close the file."""
        self._writer.close()


def _read_rows(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return [row for row in csv.DictReader(file) if None not in row.values() and row["transitions"]]


def _format(rows: list[dict[str, str]], columns: list[str]) -> str:
    text = io.StringIO()
    csv.DictWriter(text, columns, restval="", lineterminator="\n").writerows(rows)
    return text.getvalue()


def _append(path: Path, content: bytes) -> None:
    size = path.stat().st_size
    try:
        with open(path, "ab", buffering=0) as file:
            if file.write(content) != len(content):
                raise OSError(f"no space left for '{path}'")
    except OSError:
        with open(path, "rb+") as file:
            file.truncate(size)
        raise
