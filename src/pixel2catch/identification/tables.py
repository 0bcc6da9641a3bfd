"""Text tables of numbers, separated by commas or spaces; errors name file, line and column."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pixel2catch.errors import RecordingError
from pixel2catch.identification.rules import Place


@dataclass(frozen=True, kw_only=True)
class Table:
    """A text table: cells become numbers when a column is asked for.

    Attributes:
        path: The file.
        names: Names of the columns.
        rows: Cells as text, row by row.
        place: What rows are called in messages: lines of the file, counted from 1.
    """

    path: Path
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    place: Place

    def column(self, name: str) -> np.ndarray:
        """The numbers of a column.

        Raises:
            RecordingError: If there is no such column, or a cell is no number.
        """
        if name not in self.names:
            raise RecordingError(
                f"{self.path}: no column {name}; it has {', '.join(self.names)}. "
                "Record this column, or give it this name in the first line."
            )
        index = self.names.index(name)
        cells = [row[index] for row in self.rows]
        return np.array([self._number(i, name, cell) for i, cell in enumerate(cells)], dtype=np.float64)

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """The numbers of several columns, shape (rows, columns).

        Raises:
            RecordingError: As for `column`.
        """
        return np.stack([self.column(name) for name in names], axis=-1)

    def _number(self, index: int, name: str, cell: str) -> float:
        try:
            return float(cell)
        except ValueError:
            raise RecordingError(
                f"{self.place.at(index)}, column {name}: '{cell}' is no number; correct or cut this line."
            ) from None


def read_table(path: Path, names: tuple[str, ...] = ()) -> Table:
    """Read a table whose first line names the columns.

    Args:
        path: The file.
        names: Names of the columns, if the file has no such line.

    Raises:
        RecordingError: If the file cannot be read, is empty, or a line has too few or too many cells.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").strip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: not a readable text file ({error}).") from None
    rows = tuple(_cells(line) for line in lines)
    num_header_lines = 0 if names else 1
    if len(rows) <= num_header_lines:
        raise RecordingError(f"{path}: empty, there is no line of numbers; record again.")
    place = Place(source=str(path), row="line", first_row=1 + num_header_lines)
    table = Table(path=path, names=names or rows[0], rows=rows[num_header_lines:], place=place)
    _require_rectangular(table)
    return table


def _cells(line: str) -> tuple[str, ...]:
    """Comma-separated cells, or space-separated ones where there is no comma."""
    cells = line.split(",") if "," in line else line.split()
    return tuple(cell.strip() for cell in cells)


def _require_rectangular(table: Table) -> None:
    for i, row in enumerate(table.rows):
        if len(row) != len(table.names):
            raise RecordingError(
                f"{table.place.at(i)}: {len(row)} columns instead of {len(table.names)}; "
                "correct or cut this line (the last one may have been cut off while recording)."
            )
