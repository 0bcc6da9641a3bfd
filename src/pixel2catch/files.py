"""Files that are either the old ones or the new ones, never half of each; and what is written into them."""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
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


def decoded(kind: Any, value: Any, name: str = "") -> Any:
    """Read a value of a declared type from JSON: `dataclasses.asdict` and `plain` backwards.

    Args:
        kind: A dataclass, with a `from_dict` of its own or without; `Path`, what JSON knows, or tuples,
            dictionaries and unions of these. In a union one member at most is a tuple or a dataclass.
        value: What `json.loads` returned.
        name: Its name, for messages.

    Raises:
        InvalidValueError: A field is unknown or missing, or has another shape.
    """
    kind = _chosen(kind, value)
    origin, inner = get_origin(kind), get_args(kind)
    if _is_nested(kind) and not _has_shape(origin, value):
        raise InvalidValueError(f"field '{name}' is {value!r}")
    if origin is tuple:
        kinds = inner if Ellipsis not in inner else inner[:1] * len(value)
        if len(kinds) != len(value):
            raise InvalidValueError(f"field '{name}' has {len(value)} entries; it needs {len(kinds)}")
        return tuple(decoded(each, entry, name) for each, entry in zip(kinds, value, strict=True))
    if origin is dict:
        return {key: decoded(inner[1], entry, f"{name}.{key}") for key, entry in value.items()}
    if name and hasattr(kind, "from_dict"):
        return kind.from_dict(value)
    if dataclasses.is_dataclass(kind):
        return _decoded_dataclass(kind, value, f"{name}." if name else "")
    return Path(value) if kind is Path else value


def _decoded_dataclass(kind: Any, values: dict[str, Any], where: str) -> Any:
    kinds, fields = get_type_hints(kind), dataclasses.fields(kind)
    required = {each.name for each in fields if each.default is each.default_factory is dataclasses.MISSING}
    for problem, found in (
        ("is missing", required - set(values)),
        ("is unknown to this code", set(values) - {each.name for each in fields}),
    ):
        if found:
            raise InvalidValueError(f"field '{where}{min(found)}' {problem}")
    return kind(**{name: decoded(kinds[name], value, where + name) for name, value in values.items()})


def _chosen(kind: Any, value: Any) -> Any:
    """The member of a union that a value is of; any other type is itself."""
    if get_origin(kind) not in (Union, UnionType):
        return kind
    is_nested = isinstance(value, list | dict)
    members = [each for each in get_args(kind) if (each is NoneType) is (value is None)]
    return next((each for each in members if _is_nested(each) is is_nested), get_args(kind)[0])


def _has_shape(origin: Any, value: Any) -> bool:
    return isinstance(value, list if origin is tuple else dict)


def _is_nested(kind: Any) -> bool:
    return get_origin(kind) in (tuple, dict) or dataclasses.is_dataclass(kind)


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


def require_file(path: Path, endings: Sequence[str]) -> None:
    """Refuse a file that cannot be written, or whose name ends otherwise, before the work that fills it.

    Raises:
        InvalidValueError: If the ending is another, or there is no folder for it that may be written.
    """
    if path.suffix.lower() not in endings:
        raise InvalidValueError(f"cannot write '{path}': its name must end in {' or '.join(endings)}.")
    if not path.parent.is_dir():
        raise InvalidValueError(f"cannot write '{path}': there is no folder '{path.parent}'.")
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InvalidValueError(f"cannot write '{path}': it is a folder or may not be written.")


def require_free_file(path: Path) -> None:
    """Refuse a file that exists, and make the folder of one that does not.

    Raises:
        InvalidValueError: If it exists.
    """
    if path.exists():
        raise InvalidValueError(f"{path} exists; choose another name or remove it.")
    path.parent.mkdir(parents=True, exist_ok=True)
