"""Read and write files: writing is all or nothing, reading is bounded in size and memory."""

import fcntl
import json
import math
import os
import re
import reprlib
import stat
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import fields, is_dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pixel2catch.errors import InvalidValueError, Pixel2CatchError, UnknownNameError

MOST_JSON = 2 * 2**20  #: Largest JSON file [bytes]; the largest that are written have some hundred thousand.
MOST_YAML = 2**17  #: Largest YAML file [bytes]; profiles have some thousand.
MOST_NESTED = 64  #: Most levels of a YAML file; more take long to read. Profiles have some four.
MOST_WEIGHTS = 2**28  #: Largest file of a policy's networks, or checkpoint [bytes]; ours have a few million.
LONGEST_REASON = 1000  #: Most characters of a file's content that a message repeats.

DAMAGE = (AttributeError, EOFError, LookupError, OSError, OverflowError, TypeError, ValueError)
"""Exceptions that wrong content of a file can cause, besides this package's."""


def write_atomically(contents: Mapping[Path, str | bytes]) -> None:
    """Write one or several files, and make their folders; if any write fails, all keep their old content.

    Each file is first written beside its place and flushed to the disk, then the old files are replaced.
    Raises InvalidValueError for a path that is no regular file, OSError for what the disk refuses.
    """
    for path in contents:
        if path.exists() and not path.is_file():
            raise InvalidValueError(f"'{path}' is a folder, a pipe or a device; name a file.")
    try:
        with ExitStack() as stack:
            for path, content in contents.items():
                with open(stack.enter_context(replacing(path)), "wb") as file:
                    file.write(content.encode() if isinstance(content, str) else content)
                    file.flush()
                    os.fsync(file.fileno())
    except OSError as error:
        raise OSError(error.errno, error.strerror, error.filename or str(next(iter(contents)))) from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new path beside a file; what is written there replaces the file, unless there is an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.stem}.tmp{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Hold a file or a folder for this process; raise InvalidValueError if another process holds it."""
    place = os.open(path, os.O_RDWR if path.is_file() else os.O_RDONLY)
    try:
        fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise InvalidValueError(f"'{path}' is in use by another command; end it, or name another.") from error
    finally:
        os.close(place)


@contextmanager
def held_folder(path: Path, *, is_new: bool = True) -> Iterator[None]:
    """Make and hold a folder, which is empty if `is_new`; at the end remove it if it is made and empty."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    try:
        with held(path):
            if is_new and any(path.iterdir()):
                raise InvalidValueError(f"'{path}' was filled by another command; name another.")
            yield
    finally:
        with suppress(OSError):  # the first that is not empty ends it
            for folder in made:
                folder.rmdir()


def json_text(value: Any, indent: int | None = 2) -> str:
    """Return a value as JSON text, after `as_json`; it ends with a line break."""
    return json.dumps(as_json(value), indent=indent, allow_nan=False) + "\n"


def as_json(value: Any) -> Any:
    """Return a value in JSON's types: arrays become lists, NaN and infinity null, other types text."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {str(key): as_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(entry) for entry in value]
    return as_json(value.tolist()) if hasattr(value, "tolist") else str(value)


@contextmanager
def reading(
    what: str, path: Path | str, fix: str, error: type[Pixel2CatchError] = InvalidValueError
) -> Iterator[None]:
    """Turn every exception of damage into one error that names the file, the reason and the fix."""
    try:
        yield
    except (*DAMAGE, Pixel2CatchError) as damage:
        reason = f"there is no {damage}" if isinstance(damage, KeyError) else str(damage).rstrip(".")
        reason = reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]} ..."
        raise error(f"cannot read the {what} '{path}': {reason}. {fix}") from damage


def read_bytes(path: Path, most: int) -> bytes:
    """Return the content of a file of at most `most` bytes; do not wait for a pipe or a device.

    Raises InvalidValueError for a file that is not regular, is larger, or changes.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise InvalidValueError(f"'{path}' is a pipe or a device; name a file")
        if found.st_size > most:
            raise InvalidValueError(f"'{path}' has {found.st_size:,} bytes; it may have {most:,}")
        content = file.read(found.st_size + 1)
    if len(content) != found.st_size:
        raise InvalidValueError(f"'{path}' changes while it is read; wait until it is written")
    return content


def read_text(path: Path, most: int = MOST_JSON) -> str:
    """Return the content of a UTF-8 file without a byte order mark; raise as `read_bytes` does."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InvalidValueError(f"it is not UTF-8 text ({error})") from error


def parse_json(text: str) -> Any:
    """Return the content of a JSON text; refuse a key twice, deep nesting, and infinite numbers."""
    try:
        content = _bounded(json.loads(text, object_pairs_hook=_unique))
        json.dumps(content, ensure_ascii=False).encode()  # refuses half of a surrogate pair
    except (ValueError, RecursionError) as error:
        raise InvalidValueError(f"it cannot be read as JSON ({error})") from error
    return content


def json_object(text: str) -> dict[str, Any]:
    """Return the object of a JSON text; raise as `parse_json` does, or if it is not an object."""
    content = parse_json(text)
    if not isinstance(content, dict):
        raise InvalidValueError(f"it is {shown(content)}; it must be a JSON object {{...}}")
    return content


def read_json_object(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file; raise as `read_bytes` and `json_object` do."""
    return json_object(read_text(path))


def parse_yaml(text: str) -> Any:
    """Return the content of a YAML text without aliases; raise as `parse_json` does. Needs PyYAML."""
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            return _unique(
                (self.construct_object(key, True), self.construct_object(value, deep))
                for key, value in node.value
            )

    # as YAML 1.2: for PyYAML, which follows 1.1, a number without a point is a text
    Loader.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[\d.]*\d\.?[eE][-+]?\d+$"), None
    )
    try:
        depth = 0
        for event in yaml.parse(text):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > MOST_NESTED:
                raise InvalidValueError(
                    f"it has an alias ('*name') or over {MOST_NESTED} levels; write it out"
                )
        return _bounded(yaml.load(text, Loader))
    except (yaml.YAMLError, RecursionError, *DAMAGE) as error:
        raise InvalidValueError(f"it cannot be read as YAML ({' '.join(str(error).split())})") from error


def _unique(pairs: Any) -> dict[Any, Any]:
    content: dict[Any, Any] = {}
    for key, value in pairs:
        if key in content:
            raise InvalidValueError(f"it has the entry {shown(key)} twice; keep one")
        content[key] = value
    return content


def _bounded(content: Any, name: str = "it") -> Any:
    """Return content of lists and mappings whose numbers are finite and of 64 bits, as readers need."""
    if isinstance(content, float) and not math.isfinite(content):
        raise InvalidValueError(f"{name} has the number {content}; it must be finite")
    if isinstance(content, int) and not -(2**63) <= content < 2**63:
        raise InvalidValueError(f"{name} has an integer of more than 64 bits; it must be smaller")
    if isinstance(content, dict):
        for key, value in content.items():
            _bounded(value, shown(key))
    elif isinstance(content, list):
        for value in content:
            _bounded(value, name)
    return content


def printable(text: str, kept: str = "\n\t") -> str:
    """Return a text with `\ufffd` in place of control characters, which a terminal would obey."""
    return "".join(each if each.isprintable() or each in kept else "\ufffd" for each in text)


shown = reprlib.repr  #: Returns a value as a short text for a message, however large the value is.
MISSING = "Object missing required field `"  #: How msgspec's message of a missing field begins.


def decoded(kind: Any, value: Any, name: str = "") -> Any:
    """Convert what `parse_json` or `parse_yaml` returned to a declared type, such as a dataclass.

    Where an array is declared, a list becomes an array of numbers, and null in it infinity. An
    InvalidValueError has the place of the bad, missing or unknown field, below `name`.
    """
    try:
        found = msgspec.convert(value, kind, dec_hook=_other_type)
    except (msgspec.ValidationError, Pixel2CatchError) as error:
        text, _, path = str(error).rstrip(".").partition(" - at `$")
        place = (name + path.rstrip("`")).lstrip(".")
        if text.startswith(MISSING):
            place, text = f"{place}.{text[len(MISSING) : -1]}".lstrip("."), "it is missing; add it"
        raise InvalidValueError(f"field '{place}': {text}" if place else text) from error
    _require_known(found, value, name)
    return found


def take_version(content: dict[str, Any], readable: int) -> None:
    """Take the version out of a file's content; raise InvalidValueError if it is not the readable one."""
    version = content.pop("format_version", None)
    if type(version) is not int or version != readable:
        raise InvalidValueError(f"format_version is {shown(version)}, this code reads {readable}")


def _other_type(kind: Any, value: Any) -> Any:
    """Convert a value to a type that msgspec does not have: a path or an array."""
    if kind is Path:
        return Path(value) if isinstance(value, str) else value
    if not isinstance(value, list) or not all(each is None or type(each) in (float, int) for each in value):
        raise ValueError(f"Expected a list of numbers, got {shown(value)}")
    return np.array([np.inf if each is None else each for each in value], dtype=float)


def _require_known(found: Any, value: Any, name: str) -> None:
    """Raise if a value has a field that its dataclass does not have, at any depth."""
    entries: Any = ()
    if is_dataclass(found):
        names = [f"{name}.{field.name}".lstrip(".") for field in fields(found)]
        for key in value:
            if (place := f"{name}.{key}".lstrip(".")) not in names:
                raise InvalidValueError(str(UnknownNameError("field", place, names)).rstrip("."))
        entries = ((f".{key}", getattr(found, key), entry) for key, entry in value.items())
    elif isinstance(found, dict):
        entries = ((f".{key}", each, value.get(key)) for key, each in found.items())
    elif isinstance(found, tuple):
        entries = ((f"[{i}]", each, value[i]) for i, each in enumerate(found))
    for place, each, entry in entries:
        _require_known(each, entry, (name + place).lstrip("."))


def free_folder(name: str) -> Path:
    """Return the first of NAME, NAME-2, NAME-3 and so on that is not there."""
    names = chain([name], (f"{name}-{number}" for number in count(2)))
    return next(path for path in map(Path, names) if not path.exists())
