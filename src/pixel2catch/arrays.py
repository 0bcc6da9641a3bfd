"""Read arrays from npz archives and text tables; nothing larger than its limit is unpacked."""

import math
import struct
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

UNREADABLE = (BadZipFile, EOFError, RuntimeError, SyntaxError, TokenError, ValueError, zlib.error)
"""Exceptions of zipfile and numpy for damaged files."""

MOST_CHARACTERS = 2**16  #: Most characters of an array of text; names of joints have some hundred.
MOST_DIRECTORY = 2**18  #: Largest list of members of an archive [bytes]; usual are some thousand.

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_END, _END_64 = b"PK\x05\x06", b"PK\x06\x07"  # signatures at the end of an archive. Source: its specification


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
    except UNREADABLE as error:
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
    end, before = data[-22:], data[-98:-22]
    if len(end) < 22 or end[:4] != _END:
        raise BadZipFile("it does not end as an archive does")
    size = struct.unpack_from("<I", end, 12)[0]
    if before[-20:-16] == _END_64:
        size = struct.unpack_from("<Q", before, 40)[0]
    if size > MOST_DIRECTORY:
        raise InvalidValueError(f"it has too many members: a list of {size:,} bytes")
    archive = ZipFile(BytesIO(data))
    members = archive.infolist()
    if any(member.compress_type not in (ZIP_STORED, ZIP_DEFLATED) for member in members):
        raise InvalidValueError("it is packed in another way than numpy and torch do")
    if (size := sum(member.file_size for member in members)) > most:
        raise InvalidValueError(f"it has {size:,} bytes when unpacked, {most:,} are allowed; cut it")
    return archive


def _array(data: bytes) -> np.ndarray:
    """Return the array of an .npy file as a view of the data."""
    file = BytesIO(data)
    version = npy.read_magic(file)
    if version not in _HEADERS:
        raise InvalidValueError(f"it has an array of the format {version}, this code reads {[*_HEADERS]}")
    shape, is_fortran, dtype = _HEADERS[version](file)
    if dtype.kind not in "biufU":
        raise InvalidValueError(f"it has an array of {dtype}; numbers and names of joints are read")
    if dtype.kind == "U" and len(data) > 4 * MOST_CHARACTERS:
        raise InvalidValueError(f"it has a text of more than {MOST_CHARACTERS:,} characters")
    start = file.tell()
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise InvalidValueError(f"it has an array of shape {shape}, and {len(data) - start:,} bytes of it")
    if dtype.kind == "U":  # numpy accepts code points that are no characters
        data[start:].decode("utf-32-le" if dtype.isnative else "utf-32-be")
    return np.frombuffer(data, dtype, offset=start).reshape(shape, order="F" if is_fortran else "C")


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A table of text cells; columns become numbers when they are read."""

    path: Path
    names: tuple[str, ...]  #: Names of the columns.
    rows: tuple[list[str], ...]  #: Cells of each row.
    first_line: int  #: Line of the file with the first row, from 1.

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column; raise RecordingError if there is no such column."""
        if name not in self.names:
            raise RecordingError(
                f"{self.path}: no column {name}; it has {shown(list(self.names))}. Record this column, or "
                "give it this name in the first line."
            )
        column = self.names.index(name)
        return [row[column] for row in self.rows]

    def column(self, name: str) -> np.ndarray:
        """Return the numbers of a column; raise RecordingError if it is missing or has other text."""
        numbers = np.empty(len(self.rows))
        for i, cell in enumerate(self.texts(name)):
            try:
                numbers[i] = float(cell)
            except ValueError:
                raise RecordingError(
                    f"{self.path}, line {self.first_line + i}, column {name}: {shown(cell)} is not a number; "
                    "correct or cut this line."
                ) from None
        return numbers

    def columns(self, names: Iterable[str]) -> np.ndarray:
        """Return the numbers of several columns, shape (rows, columns); raise as `column` does."""
        return np.stack([self.column(name) for name in names], axis=-1)


def read_table(path: Path, names: tuple[str, ...] = ()) -> TextTable:
    """Read cells between commas, or spaces where a line has no comma; line 1 has the names, unless given.

    Raises:
        RecordingError: The file cannot be read, is empty or too long, or a line has another number of cells.
    """
    with reading("table", path, "Record again, or cut it.", RecordingError):
        text = read_text(path, MOST_TABLE).strip()
        if text.count("\n") > MOST_ROWS:
            raise RecordingError(f"it has more than {MOST_ROWS:,} lines")
    cells = [
        [cell.strip() for cell in line.split(",")] if "," in line else line.split()
        for line in text.split("\n")
    ]
    first = 0 if names else 1
    if len(cells) <= first or not text:
        raise RecordingError(f"{path}: there is no line of numbers; record again.")
    names, rows = names or tuple(cells[0]), tuple(cells[first:])
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise RecordingError(
                f"{path}, line {1 + first + i}: {len(row)} columns instead of {len(names)}; correct or cut "
                "this line (the last one may have been cut off while recording)."
            )
    return TextTable(path=path, names=names, rows=rows, first_line=1 + first)
