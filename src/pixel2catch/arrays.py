"""Read arrays from npz archives and text tables; nothing larger than its limit is unpacked."""

import zlib
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile

import numpy as np
from jaxtyping import Float64
from numpy.lib import format as npy

from pixel2catch.checks import OutputFile
from pixel2catch.errors import InvalidValueError, RecordingError
from pixel2catch.files import read_bytes, read_text, reading, shown, write_atomically

MOST_NUMBERS = 2**24
"""Most numbers in all arrays of a file: 20 minutes of an arm at 500 Hz, 128 MiB. Source: ours."""

MOST_TABLE, MOST_ROWS = 2**25, 2**19
"""Most bytes and lines of a text table: a quarter of an hour at 500 Hz. Source: ours."""

DAMAGED = (BadZipFile, EOFError, MemoryError, RuntimeError, SyntaxError, TokenError, ValueError, zlib.error)
"""Exceptions of zipfile and numpy for damaged files."""

MOST_CHARACTERS = 2**16  #: Most characters of an array of text; names of joints have some hundred.


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return those of the named arrays that an .npz file has: numbers or short text.

    Raises InvalidValueError if it is not an .npz file, or too large; nothing was unpacked then.
    """
    data = read_bytes(path, 8 * MOST_NUMBERS)
    try:
        with open_archive(data, 8 * MOST_NUMBERS) as archive:
            there = {*archive.namelist()}
            arrays = {name: _array(archive.read(f"{name}.npy")) for name in names if f"{name}.npy" in there}
    except DAMAGED as error:
        raise InvalidValueError(f"it cannot be read as an npz file ({error})") from error
    if sum(array.size for array in arrays.values()) > MOST_NUMBERS:
        raise InvalidValueError(f"it has more than {MOST_NUMBERS:,} numbers; cut it")
    return arrays


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays to a new .npz file; raise InvalidValueError if it exists."""
    OutputFile(is_new=True).require("file", path)
    buffer = BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomically({path: buffer.getvalue()})


def open_archive(data: bytes, most: int) -> ZipFile:
    """Return a zip archive whose unpacked members have at most `most` bytes together.

    Raises InvalidValueError if they have more, or are packed in a way that hides it.
    """
    archive = ZipFile(BytesIO(data))
    members = archive.infolist()
    if any(member.compress_type not in (ZIP_STORED, ZIP_DEFLATED) for member in members):
        raise InvalidValueError("it is packed in another way than numpy and torch do")
    if (size := sum(member.file_size for member in members)) > most:
        raise InvalidValueError(f"it has {size:,} bytes when unpacked, {most:,} are allowed; cut it")
    return archive


def _array(data: bytes) -> np.ndarray:
    array = npy.read_array(BytesIO(data), allow_pickle=False)
    if array.dtype.kind not in "biufU":
        raise InvalidValueError(f"it has an array of {array.dtype}; numbers and names of joints are read")
    if array.dtype.kind == "U":
        if len(data) > 4 * MOST_CHARACTERS:
            raise InvalidValueError(f"it has a text of more than {MOST_CHARACTERS:,} characters")
        "".join(array.ravel().tolist()).encode()  # numpy accepts code points that are no characters
    return array


def table_columns(path: Path, names: Sequence[str] = ()) -> dict[str, tuple[str, ...]]:
    """Return the cells of a table by the names of its columns, in line 1 unless they are given.

    The separator is the first of semicolon, tab and comma that line 1 has, or else spaces. Raises
    RecordingError for a file that cannot be read or is too long, or a line with too few or too many cells.
    """
    with reading("table", path, "Record again, or correct or cut the line.", RecordingError):
        lines = read_text(path, MOST_TABLE).strip().split("\n")
        if len(lines) > MOST_ROWS:
            raise RecordingError(f"it has more than {MOST_ROWS:,} lines")
        separator = next((each for each in ";\t," if each in lines[0]), None)
        rows = [[cell.strip(' \r"') for cell in line.strip().split(separator)] for line in lines]
        names, first = (names, 1) if names else (rows.pop(0), 2)
        for number, row in enumerate(rows or [[]], first):
            if len(row) != len(names):
                raise RecordingError(f"line {number}: {len(row)} columns instead of {len(names)}")
        return dict(zip(names, zip(*rows, strict=True), strict=True))


def numbers_of(
    path: Path, table: Mapping[str, Sequence[str]], columns: Sequence[str]
) -> Float64[np.ndarray, "rows columns"]:
    """Return some columns of numbers of a table, which may have decimal commas, or raise RecordingError."""
    with reading("table", path, "Record again, or correct or cut the line.", RecordingError):
        for name in columns:
            if name not in table:
                raise RecordingError(f"no column {name}; it has {shown(list(table))}")
        return np.array([[float(cell.replace(",", ".")) for cell in table[name]] for name in columns]).T


def read_table(
    path: Path, columns: Sequence[str], text: str = "", names: Sequence[str] = ()
) -> tuple[Float64[np.ndarray, "rows columns"], list[str]]:
    """Return columns of numbers of a table, and a column of text if it is named; raise RecordingError."""
    table = table_columns(path, names)
    if text and text not in table:
        raise RecordingError(f"cannot read the table '{path}': no column {text}; it has {shown([*table])}.")
    return numbers_of(path, table, columns), list(table.get(text, ()))
