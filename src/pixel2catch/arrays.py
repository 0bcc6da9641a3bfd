"""Read arrays from npz archives and text tables; nothing larger than its limit is unpacked."""

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile

import numpy as np
from numpy.lib import format as npy

from pixel2catch.errors import InvalidValueError, RecordingError
from pixel2catch.files import read_bytes, read_text, reading, require_free_file, shown, write_atomically

MOST_NUMBERS = 2**24
"""Most numbers in all arrays of a file: 20 minutes of an arm at 500 Hz, 128 MiB. Source: ours."""

MOST_TABLE, MOST_ROWS = 2**25, 2**19
"""Most bytes and lines of a text table: a quarter of an hour at 500 Hz. Source: ours."""

DAMAGED = (BadZipFile, EOFError, MemoryError, RuntimeError, SyntaxError, TokenError, ValueError, zlib.error)
"""Exceptions of zipfile and numpy for damaged files."""

MOST_CHARACTERS = 2**16  #: Most characters of an array of text; names of joints have some hundred.


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return those of the named arrays that an .npz file has: numbers or short text.

    Raises:
        OSError: It cannot be read.
        InvalidValueError: It is not an .npz file, or too large; nothing was unpacked then.
    """
    data = read_bytes(path, 8 * MOST_NUMBERS)
    try:
        with open_archive(data, 8 * MOST_NUMBERS) as archive:
            members = {name: f"{name}.npy" for name in names}
            there = {*archive.namelist()}
            arrays = {name: _array(archive.read(m)) for name, m in members.items() if m in there}
    except InvalidValueError:
        raise
    except DAMAGED as error:
        raise InvalidValueError(f"it is not a whole npz file ({error})") from error
    if sum(array.size for array in arrays.values()) > MOST_NUMBERS:
        raise InvalidValueError(f"it has more than {MOST_NUMBERS:,} numbers; cut it")
    return arrays


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays to a new .npz file; raise InvalidValueError if it exists."""
    require_free_file(path)
    buffer = BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomically({path: buffer.getvalue()})


def open_archive(data: bytes, most: int) -> ZipFile:
    """Return a zip archive whose unpacked members have at most `most` bytes together.

    Raises:
        InvalidValueError: They have more, or are packed in a way that hides it.
        BadZipFile: It is damaged.
    """
    archive = ZipFile(BytesIO(data))
    members = archive.infolist()
    if any(member.compress_type not in (ZIP_STORED, ZIP_DEFLATED) for member in members):
        raise InvalidValueError("it is packed in another way than numpy and torch do")
    if (size := sum(member.file_size for member in members)) > most:
        raise InvalidValueError(f"it has {size:,} bytes when unpacked, {most:,} are allowed; cut it")
    return archive


def _array(data: bytes) -> np.ndarray:
    """Return the array of an .npy file."""
    array = npy.read_array(BytesIO(data), allow_pickle=False)
    if array.dtype.kind not in "biufU":
        raise InvalidValueError(f"it has an array of {array.dtype}; numbers and names of joints are read")
    if array.dtype.kind == "U":
        if len(data) > 4 * MOST_CHARACTERS:
            raise InvalidValueError(f"it has a text of more than {MOST_CHARACTERS:,} characters")
        "".join(array.ravel().tolist()).encode()  # numpy accepts code points that are no characters
    return array


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A table of text cells; columns become numbers when they are read."""

    path: Path
    cells: dict[str, list[str]]  #: Cells of each column.

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column; raise RecordingError if there is no such column."""
        if name not in self.cells:
            raise RecordingError(
                f"{self.path}: no column {name}; it has {shown(list(self.cells))}. Record this column, or "
                "give it this name in the first line."
            )
        return self.cells[name]

    def columns(self, names: Iterable[str]) -> np.ndarray:
        """Return the numbers of columns, (rows, columns); raise RecordingError if one is missing or text."""
        try:
            return np.stack([np.array([float(cell) for cell in self.texts(name)]) for name in names], axis=-1)
        except ValueError as error:
            raise RecordingError(f"{self.path}: {shown(str(error))}; correct or cut this line.") from None


def read_table(path: Path, names: tuple[str, ...] = ()) -> TextTable:
    """Read cells between commas, or spaces where a line has no comma; line 1 has the names, unless given.

    Raises:
        RecordingError: The file cannot be read, is empty or too long, or a line has another number of cells.
    """
    with reading("table", path, "Record again, or cut it.", RecordingError):
        lines = read_text(path, MOST_TABLE).strip().split("\n")
        if len(lines) > MOST_ROWS:
            raise RecordingError(f"it has more than {MOST_ROWS:,} lines")
    rows = [
        [cell.strip() for cell in line.split(",")] if "," in line else line.split()
        for line in ([",".join(names)] if names else []) + lines
    ]
    if len(rows) == 1 or not rows[-1]:
        raise RecordingError(f"{path}: there is no line of numbers; record again.")
    for number, row in enumerate(rows, start=0 if names else 1):
        if len(row) != len(rows[0]):
            raise RecordingError(
                f"{path}, line {number}: {len(row)} columns instead of {len(rows[0])}; correct or cut "
                "this line (the last one may have been cut off while recording)."
            )
    return TextTable(path=path, cells=dict(zip(rows[0], map(list, zip(*rows[1:], strict=True)), strict=True)))
