"""Files that are either the old ones or the new ones, never half of each; and what is written into them."""

import dataclasses
import math
import os
from collections.abc import Mapping
from itertools import repeat
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from pixel2catch.errors import InvalidValueError


def write_atomically(contents: Mapping[Path, bytes]) -> None:
    """Write one or several files; when any write fails, all the files keep their old content.

    Every file is first written completely beside its place (`<name>.tmp`) and flushed to the disk; only then
    are the old ones replaced. A full disk or a kill in between leaves the old files as they were.

    Args:
        contents: The new content of each file. The folders must exist.

    Raises:
        OSError: The disk is full, read-only or gone; nothing was replaced.
    """
    temporaries = {path: path.with_name(path.name + ".tmp") for path in contents}
    try:
        for path, content in contents.items():
            with open(temporaries[path], "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        for path, temporary in temporaries.items():
            os.replace(temporary, path)
    finally:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)


def plain(value: Any) -> Any:
    """What JSON does not know, for `json.dumps(default=plain)`: arrays as lists, anything else as text.

    An infinite entry of an array is null, as JSON has no infinity.
    """
    return _without_infinity(value.tolist()) if hasattr(value, "tolist") else str(value)


def _without_infinity(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_infinity(entry) for entry in value]
    return None if isinstance(value, float) and math.isinf(value) else value


def decoded(kind: Any, value: Any) -> Any:
    """A value of a declared type from what JSON holds of it: `dataclasses.asdict` and `plain` backwards.

    Args:
        kind: A dataclass, with a `from_dict` or without, `Path`, what JSON knows, or tuples, dictionaries and
            unions of these; at most one member of a union may be a tuple or a dataclass.
        value: What `json.loads` returned.

    Raises:
        TypeError: A field is unknown, or a required one missing.
        ValueError: A value is of another kind, or out of range.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        if value is None and NoneType in inner:
            return None
        is_nested = isinstance(value, list | dict)
        fitting = [
            each
            for each in inner
            if (get_origin(each) is tuple or dataclasses.is_dataclass(each)) is is_nested
        ]
        return decoded(fitting[0], value)
    if hasattr(kind, "from_dict"):
        return kind.from_dict(value)
    if dataclasses.is_dataclass(kind):
        return decoded_fields(kind, value)
    if origin is tuple:
        kinds = repeat(inner[0], len(value)) if inner[-1] is Ellipsis else inner
        return tuple(decoded(each, entry) for each, entry in zip(kinds, value, strict=True))
    if origin is dict:
        return {name: decoded(inner[1], entry) for name, entry in value.items()}
    return Path(value) if kind is Path else value


def decoded_fields(kind: Any, values: Mapping[str, Any]) -> Any:
    """A dataclass from its fields, see `decoded`."""
    kinds = get_type_hints(kind)
    unknown = set(values) - set(kinds)
    if unknown:
        raise TypeError(f"{kind.__name__} has no '{min(unknown)}'")
    return kind(**{name: decoded(kinds[name], value) for name, value in values.items()})


def require_free_folder(folder: Path, option: str = "--out") -> None:
    """Refuse a folder in which something would be lost, or that cannot be made.

    Args:
        folder: Where files are to be written.
        option: The option that named it, for the message.

    Raises:
        InvalidValueError: If it is a file, has anything in it, or is where nothing can be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InvalidValueError(f"'{folder}' is not an empty folder; choose another {option}, or empty it.")
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise InvalidValueError(f"'{folder}' cannot be made in '{there}'; choose another {option}.")


def require_free_file(path: Path) -> None:
    """Refuse a file that exists, and make the folder of one that does not.

    Raises:
        InvalidValueError: If it exists.
    """
    if path.exists():
        raise InvalidValueError(f"{path} exists; choose another name or remove it.")
    path.parent.mkdir(parents=True, exist_ok=True)
