"""Files that are either the old ones or the new ones, never half of each; and what is written into them."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from pixel2catch.errors import InvalidValueError

JSON_KINDS = {list: "a list", str: "a text", int: "a number", float: "a number", bool: "true or false"}
"""What JSON may hold instead of an object, in words."""


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
    except OSError as error:
        raise OSError(error.errno, error.strerror, error.filename or str(next(iter(contents)))) from error
    finally:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)


def json_text(value: Any, indent: int | None = 2) -> str:
    """A line or lines of JSON as other programs read it, too: what `as_json` makes of a value."""
    return json.dumps(as_json(value), indent=indent, allow_nan=False) + "\n"


def as_json(value: Any) -> Any:
    """A value in what JSON knows: tuples and arrays as lists, NaN and infinity as null, else text."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {str(key): as_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(entry) for entry in value]
    return as_json(value.tolist()) if hasattr(value, "tolist") else str(value)


def read_json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        OSError: It cannot be read.
        ValueError: It is no JSON, or JSON of another kind.
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise InvalidValueError(
            f"it holds {JSON_KINDS.get(type(content), 'null')}, not a JSON object {{...}}"
        )
    return content


def decoded(kind: Any, value: Any, name: str = "") -> Any:
    """Read a value of a declared type from JSON: `dataclasses.asdict` and `as_json` backwards.

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


def require_free_file(path: Path) -> None:
    """Refuse a file that exists, and make the folder of one that does not.

    Raises:
        InvalidValueError: If it exists.
    """
    if path.exists():
        raise InvalidValueError(f"{path} exists; choose another name or remove it.")
    path.parent.mkdir(parents=True, exist_ok=True)
