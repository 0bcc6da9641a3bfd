"""Zip archives of arrays, read within bounds: nothing is unpacked before it is known how large it is."""

import math
import struct
import zlib
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile

import numpy as np
from numpy.lib import format as npy

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import read_bytes, require_free_file, write_atomically

MOST_NUMBERS = 2**24
"""Numbers in all arrays of a file: 20 minutes of an arm at 500 Hz, 128 MiB. Source: ours."""

UNREADABLE = (BadZipFile, EOFError, RuntimeError, SyntaxError, TokenError, ValueError, zlib.error)
"""What zipfile and numpy raise where a file is damaged."""

MOST_CHARACTERS = 2**16  #: Of arrays of text, together; names of joints have some hundred.
MOST_DIRECTORY = 2**18  #: Bytes of an archive's list of its members: some thousand. Source: ours.

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_END, _END_64 = b"PK\x05\x06", b"PK\x06\x07"  # signatures of what ends an archive. Source: its specification


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Those of some arrays that an .npz file has: numbers, or text of a few thousand characters.

    Raises:
        OSError: It cannot be read.
        InvalidValueError: It is no such file, or too large; nothing was unpacked then.
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
        raise InvalidValueError(f"it is no whole npz file ({error})") from error
    if sum(array.size for array in arrays.values()) > MOST_NUMBERS:
        raise InvalidValueError(f"it has more than {MOST_NUMBERS:,} numbers; cut it")
    return arrays


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays to a new .npz file.

    Raises:
        InvalidValueError: If it exists; nothing is overwritten.
    """
    require_free_file(path)
    buffer = BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomically({path: buffer.getvalue()})


def open_archive(data: bytes, most: int) -> ZipFile:
    """A zip archive whose members have so many bytes together at the most.

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
    """The array of an .npy file, a view of the data."""
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
    if dtype.kind == "U":
        # numpy would make no text of others
        data[start:].decode("utf-32-le" if dtype.isnative else "utf-32-be")
    return np.frombuffer(data, dtype, offset=start).reshape(shape, order="F" if is_fortran else "C")
