"""From YAML to frozen dataclasses: their fields and types are the schema. Errors name file, key, fix.

Own code, as it is small: pydantic and msgspec know no closest name, and neither is needed for anything else.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import yaml

from pixel2catch.errors import DeploymentError, Pixel2CatchError, UnknownNameError
from pixel2catch.ros2.transport import Topic

T = TypeVar("T")


@dataclass(frozen=True)
class TopicType:
    """Of a field that is a topic, and in the file its name: `Annotated[Topic, TopicType(type)]`.

    Attributes:
        type: ROS type of its messages.
        is_latched: Whether late subscribers get the last one.
    """

    type: str
    is_latched: bool = False


def read_yaml(path: Path, kind: type[T]) -> T:
    """Read a file as a value of a dataclass.

    Args:
        path: The file.
        kind: The dataclass.

    Raises:
        DeploymentError: The file cannot be read, or does not fit.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DeploymentError(f"{path}: cannot be read ({error}); correct it.") from error
    return _parse(str(path), content, kind)


def _parse(place: str, value: Any, kind: Any) -> Any:
    """A value of a type, or an error that names the place."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        sends = kind.__metadata__[0]
        return Topic(name=_topic_name(place, value), type=sends.type, is_latched=sends.is_latched)
    if origin is UnionType or NoneType in arguments:
        inner = next(argument for argument in arguments if argument is not NoneType)
        return None if value is None else _parse(place, value, inner)
    if origin is Literal:
        return _choice(place, value, arguments)
    if origin is tuple:
        return tuple(
            _parse(f"{place}[{i}]", entry, arguments[0]) for i, entry in enumerate(_list(place, value))
        )
    if origin is dict:
        pairs = _mapping(place, value).items()
        return {_parse(place, k, arguments[0]): _parse(f"{place}.{k}", v, arguments[1]) for k, v in pairs}
    if is_dataclass(kind):
        return _record(place, _mapping(place, value), kind)
    return _plain(place, value, kind)


def _record(place: str, value: Mapping[Any, Any], kind: Any) -> Any:
    hints = get_type_hints(kind, include_extras=True)
    for key in value:
        if key not in hints:
            raise DeploymentError(f"{place}: {UnknownNameError('key', str(key), hints)}")
    needed = [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]
    missing = [name for name in needed if name not in value]
    if missing:
        raise DeploymentError(f"{place}: {', '.join(missing)} missing; add it.")
    try:
        return kind(**{key: _parse(f"{place}: {key}", entry, hints[key]) for key, entry in value.items()})
    except DeploymentError:
        raise
    except Pixel2CatchError as error:
        raise DeploymentError(f"{place}: {error}") from error


def _plain(place: str, value: Any, kind: type) -> Any:
    """A text or a number; a whole number is one with a fraction, too."""
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise DeploymentError(f"{place}: {value!r} is not of type {kind.__name__}; correct it.")
    return value


def _choice(place: str, value: Any, valid: tuple[str, ...]) -> str:
    if value not in valid:
        raise DeploymentError(f"{place}: {UnknownNameError('value', str(value), valid)}")
    return value


def _topic_name(place: str, value: Any) -> str:
    name = _plain(place, value, str)
    if not name.startswith("/"):
        raise DeploymentError(f"{place}: '{name}' is no topic; write its whole name: '/{name}'.")
    return name


def _list(place: str, value: Any) -> list[Any]:
    return _plain(place, value, list)


def _mapping(place: str, value: Any) -> Mapping[Any, Any]:
    if not isinstance(value, dict):
        raise DeploymentError(f"{place}: {value!r} has no keys; write 'key: value'.")
    return value
