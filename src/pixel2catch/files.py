"""Files: written whole or not at all, and read within bounds of size, depth, time and memory.

Whoever wrote a file that is read here, it is a mistake in it that is said, nothing else happens.
"""

import dataclasses
import json
import math
import os
import reprlib
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pixel2catch.errors import InvalidValueError, Pixel2CatchError, UnknownNameError

JSON_KINDS = {list: "a list", str: "a text", int: "a number", float: "a number", bool: "true or false"}
"""What JSON may hold instead of an object, in words."""

MOST_JSON = 2 * 2**20  #: Bytes of a JSON file; the largest that are written have some hundred thousand.
MOST_YAML = 2**17  #: Bytes of a YAML file; profiles have some thousand.
MOST_WEIGHTS = 2**28  #: Bytes of a policy's networks, or of a checkpoint; ours have a few million.
MOST_DEPTH = 32  #: Lists and objects in each other. Source: ours; four times what is written.
LARGEST_INTEGER = 2**63  #: Integers are smaller, as everything that takes them counts in 64 bits.

LONGEST_REASON = 1000  #: Characters of a file's content that a message repeats.

DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    OverflowError,
    Pixel2CatchError,
)
"""What making a value of a file's content can raise where the content is not what it should be."""


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


@contextmanager
def reading(
    what: str, path: Path | str, fix: str, error: type[Pixel2CatchError] = InvalidValueError
) -> Iterator[None]:
    """One error for all that is wrong with a file: which it is, the reason, and the fix.

    Raises:
        error: Whatever of `DAMAGE` was raised within.
    """
    try:
        yield
    except DAMAGE as damage:
        reason = f"there is no {damage}" if isinstance(damage, KeyError) else str(damage).rstrip(".")
        reason = reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]} ..."
        raise error(f"cannot read the {what} '{path}': {reason}. {fix}") from damage


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a file of so many bytes at the most; a pipe or a device is none, and nothing waits.

    Raises:
        OSError: It cannot be read.
        InvalidValueError: It is no file, longer, or being written.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise InvalidValueError(f"'{path}' is no file, but a pipe or a device; name a file")
        if found.st_size > most:
            raise InvalidValueError(f"'{path}' has {found.st_size:,} bytes; it may have {most:,}")
        content = file.read(found.st_size + 1)
    if len(content) != found.st_size:
        raise InvalidValueError(f"'{path}' changes while it is read; wait until it is written")
    return content


def read_text(path: Path, most: int = MOST_JSON) -> str:
    """The content of a text file, without a byte order mark; raises as `read_bytes`, or if it is no UTF-8."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InvalidValueError(f"it is no text in UTF-8 ({error})") from error


def parse_json(text: str) -> Any:
    """What a JSON text holds.

    Raises:
        InvalidValueError: It is no JSON, names something twice, or has a number that none of ours is.
    """
    try:
        content = _bounded(json.loads(text, object_pairs_hook=_unique))
        json.dumps(content, ensure_ascii=False).encode()  # half a character can be written in JSON only
        return content
    except InvalidValueError:
        raise
    except (ValueError, RecursionError) as error:
        raise InvalidValueError(f"it is no JSON ({error})") from error


def json_object(text: str) -> dict[str, Any]:
    """The object that a JSON text holds; raises as `parse_json`, or if it holds something else."""
    content = parse_json(text)
    if not isinstance(content, dict):
        raise InvalidValueError(
            f"it holds {JSON_KINDS.get(type(content), 'null')}, not a JSON object {{...}}"
        )
    return content


def read_json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        OSError: It cannot be read.
        InvalidValueError: It is no JSON within bounds, or JSON of another kind.
    """
    return json_object(read_text(path))


def parse_yaml(text: str) -> Any:
    """What a YAML text holds, in which nothing has an alias. Needs PyYAML.

    Raises:
        InvalidValueError: It is no YAML, names something twice, or has a number that none of ours is.
    """
    import yaml

    parser = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        depth = 0
        for event in yaml.parse(text, parser):
            if isinstance(event, yaml.AliasEvent):
                raise InvalidValueError(f"it has the alias '*{event.anchor}'; write out what it stands for")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            _require_depth(depth)
        loader = parser(text)
        loader.construct_mapping = lambda node, deep=False: _unique(
            (loader.construct_object(key, deep=True), loader.construct_object(value, deep=deep))
            for key, value in node.value
        )
        return _bounded(loader.get_single_data())
    except InvalidValueError:
        raise
    except (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        raise InvalidValueError(f"it is no YAML ({' '.join(str(error).split())})") from error


def _unique(pairs: Any) -> dict[Any, Any]:
    """The mapping of some pairs, each key of which is there once."""
    content: dict[Any, Any] = {}
    for key, value in pairs:
        if key in content:
            raise InvalidValueError(f"it has the entry {shown(key)} twice; keep one")
        content[key] = value
    return content


def _bounded(content: Any) -> Any:
    """Content of lists and mappings, not too deep, and of finite numbers that are not too large."""
    level, depth = [("it", content)], 0
    while level:
        _require_depth(depth)
        for name, value in level:
            if isinstance(value, float) and not math.isfinite(value):
                raise InvalidValueError(f"{name} has the number {value}; it must be finite")
            if isinstance(value, int) and not -LARGEST_INTEGER <= value < LARGEST_INTEGER:
                raise InvalidValueError(f"{name} has an integer of more than 64 bits; it must be smaller")
        lists = [(name, each) for name, value in level if isinstance(value, list) for each in value]
        mappings = (value.items() for _, value in level if isinstance(value, dict))
        level = lists + [(shown(key), each) for items in mappings for key, each in items]
        depth += 1
    return content


def _require_depth(depth: int) -> None:
    if depth > MOST_DEPTH:
        raise InvalidValueError(f"its lists and entries are nested deeper than {MOST_DEPTH} times")


def shown(value: Any) -> str:
    """A value for a message, which stays short whatever the value is."""
    return reprlib.repr(value)


def decoded(kind: Any, value: Any, name: str = "") -> Any:
    """Read a value of a declared type from JSON or YAML: `dataclasses.asdict` and `as_json` backwards.

    Args:
        kind: A dataclass, with a `from_dict` of its own or without; `Path`, what JSON knows, or tuples,
            dictionaries and unions of these. In a union one member at most is a tuple or a dataclass. What
            is annotated with something that has a `from_text` is what that makes of a text.
        value: What `parse_json` or `parse_yaml` returned.
        name: Its name, for messages.

    Raises:
        InvalidValueError: A field is unknown or missing, or has another shape or a bad value.
    """
    kind = _chosen(kind, value)
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        text = decoded(str, value, name)
        return _located(name, lambda: inner[1].from_text(text))
    if (_is_nested(kind) and not _has_shape(origin, value)) or not _is_of(kind, value):
        raise InvalidValueError(f"field '{name}' is {shown(value)}; it must be {_in_words(kind)}")
    if origin is tuple:
        kinds = inner if Ellipsis not in inner else inner[:1] * len(value)
        if len(kinds) != len(value):
            raise InvalidValueError(f"field '{name}' has {len(value)} entries; it needs {len(kinds)}")
        pairs = enumerate(zip(kinds, value, strict=True))
        return tuple(decoded(each, entry, f"{name}[{i}]") for i, (each, entry) in pairs)
    if origin in (dict, Mapping):
        names = {key: f"{name}.{key}" for key in value}
        return {
            decoded(inner[0], key, names[key]): decoded(inner[1], value[key], names[key]) for key in value
        }
    if name and hasattr(kind, "from_dict"):
        return kind.from_dict(value)
    if dataclasses.is_dataclass(kind):
        return _decoded_dataclass(kind, value, name)
    return kind(value) if kind in (Path, float) else value


def _decoded_dataclass(kind: Any, values: dict[str, Any], name: str) -> Any:
    where = f"{name}." if name else ""
    kinds, fields = get_type_hints(kind, include_extras=True), dataclasses.fields(kind)
    required = {each.name for each in fields if each.default is each.default_factory is dataclasses.MISSING}
    for each in values:
        if each not in kinds:
            unknown = UnknownNameError("field", f"{where}{each}", [where + field.name for field in fields])
            raise InvalidValueError(str(unknown).rstrip("."))
    if missing := required - set(values):
        raise InvalidValueError(f"field '{where}{min(missing)}' is missing; add it")
    given = {each: decoded(kinds[each], value, where + each) for each, value in values.items()}
    return _located(name, lambda: kind(**given))


def _located(name: str, make: Callable[[], Any]) -> Any:
    """What a function makes of the value by that name, or an error that says where it is."""
    try:
        return make()
    except Pixel2CatchError as error:
        if not name:
            raise
        raise InvalidValueError(f"field '{name}': {error}") from error


def _chosen(kind: Any, value: Any) -> Any:
    """The member of a union that a value is of; any other type is itself, without its annotations."""
    if get_origin(kind) is Annotated and not hasattr(get_args(kind)[1], "from_text"):
        return _chosen(get_args(kind)[0], value)
    if get_origin(kind) not in (Union, UnionType):
        return kind
    is_nested = isinstance(value, list | dict)
    members = [_chosen(each, value) for each in get_args(kind) if (each is NoneType) is (value is None)]
    fitting = (each for each in members if _is_nested(each) is is_nested and _is_of(each, value))
    return next(fitting, (members or get_args(kind))[0])


def _is_of(kind: Any, value: Any) -> bool:
    """Whether a value can be one of a plain type, such as a number; of other types it may be."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if kind is NoneType:
        return value is None
    accepted = {float: (float, int), int: (int,), str: (str,), Path: (str,), bool: (bool,)}.get(kind)
    return accepted is None or (isinstance(value, accepted) and isinstance(value, bool) is (kind is bool))


def _has_shape(origin: Any, value: Any) -> bool:
    return isinstance(value, list if origin is tuple else dict)


def _is_nested(kind: Any) -> bool:
    return get_origin(kind) in (tuple, dict, Mapping) or dataclasses.is_dataclass(kind)


def _in_words(kind: Any) -> str:
    """What a value of a type is, for messages."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    if _is_nested(kind):
        return "a list" if get_origin(kind) is tuple else "entries of a name and a value"
    return {int: "a whole number", Path: "a text", NoneType: "null"}.get(kind) or JSON_KINDS[kind]


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
