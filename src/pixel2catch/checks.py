"""What values must be, declared at the fields of configurations and options and checked in one place."""

import math
import os
import re
import typing
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, final, get_args, get_origin

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import require_free_file, require_free_folder

LARGEST = 1e12  #: Largest number where a field states no other bound.


class Requirement(ABC):
    """A condition on a value, as a part of its type: `Annotated[int, Within(1, 9)]`."""

    @abstractmethod
    def require(self, name: str, value: Any) -> None:
        """Raise if the value of the field with this name does not meet the condition.

        Raises:
            InvalidValueError: With the value, what is valid, and the fix.
        """


@final
@dataclass(frozen=True)
class Within(Requirement):
    """A number, or each number of a tuple, between two bounds, both included."""

    low: float
    high: float = LARGEST

    def require(self, name: str, value: Any) -> None:  # noqa: D102 (documented in the interface)
        for number in _numbers(value):
            if not self.low <= number <= self.high:
                bounds = f"from {_shown(self.low)} to {_shown(self.high)}"
                raise InvalidValueError(f"{name} is {_shown(number)}; it must be {bounds}.")


@final
@dataclass(frozen=True)
class Above(Requirement):
    """A number, or each number of a tuple, greater than a bound, and at most another."""

    low: float
    high: float = LARGEST

    def require(self, name: str, value: Any) -> None:  # noqa: D102
        for number in _numbers(value):
            if not self.low < number <= self.high:
                bounds = f"greater than {_shown(self.low)}, and at most {_shown(self.high)}"
                raise InvalidValueError(f"{name} is {_shown(number)}; it must be {bounds}.")


@final
@dataclass(frozen=True)
class MultipleOf(Requirement):
    """A whole multiple of a number."""

    unit: float

    def require(self, name: str, value: float) -> None:  # noqa: D102
        if abs(value / self.unit - round(value / self.unit)) > 1e-6:
            raise InvalidValueError(
                f"{name} is {_shown(value)}; it must be a multiple of {_shown(self.unit)}."
            )


@final
@dataclass(frozen=True)
class InOrder(Requirement):
    """A tuple whose first two numbers do not fall."""

    def require(self, name: str, value: tuple[float, ...]) -> None:  # noqa: D102
        if value[0] > value[1]:
            given = " ".join(map(_shown, value[:2]))
            raise InvalidValueError(f"{name} is {given}; give the smaller number first.")


@final
@dataclass(frozen=True)
class NotEmpty(Requirement):
    """A tuple with at least one entry."""

    def require(self, name: str, value: tuple[Any, ...]) -> None:  # noqa: D102
        if not value:
            raise InvalidValueError(f"{name} is empty; give at least one value.")


@final
@dataclass(frozen=True)
class UnitLength(Requirement):
    """Numbers whose squares add up to 1, such as a quaternion."""

    def require(self, name: str, value: tuple[float, ...]) -> None:  # noqa: D102
        length = math.sqrt(sum(number * number for number in value))
        if not abs(length - 1.0) <= 1e-3:
            raise InvalidValueError(f"{name} has length {_shown(length)}; it must have length 1.")


@final
@dataclass(frozen=True)
class Matching(Requirement):
    """A text of a form."""

    pattern: str  #: Regular expression of all of it.
    valid: str  #: What is valid, for the message.

    def require(self, name: str, value: str) -> None:  # noqa: D102
        if not re.fullmatch(self.pattern, value):
            raise InvalidValueError(f"{name} is '{value}'; it must be {self.valid}.")


@final
@dataclass(frozen=True)
class OutputFile(Requirement):
    """A file that can be written; its folder is made later."""

    endings: tuple[str, ...] = ()  #: How its name may end; any if empty.
    is_new: bool = False  #: Whether it must not be there yet.

    def require(self, name: str, value: Path) -> None:  # noqa: D102
        if self.endings and value.suffix.lower() not in self.endings:
            valid = " or ".join(self.endings)
            raise InvalidValueError(f"{name} is '{value}'; end the file's name in {valid}.")
        if value.is_dir():
            raise InvalidValueError(f"{name} is '{value}', a folder; name a file in it.")
        if value.exists() and not value.is_file():
            raise InvalidValueError(f"{name} is '{value}', a pipe or a device; name a file.")
        if self.is_new:
            require_free_file(value)
        _require_place(name, value.parent)
        if value.exists() and not os.access(value, os.W_OK):
            raise InvalidValueError(f"{name} is '{value}', which cannot be written; name another file.")


@final
@dataclass(frozen=True)
class OutputFolder(Requirement):
    """A folder that is there, or can be made."""

    is_empty: bool = False  #: Whether nothing may be in it.

    def require(self, name: str, value: Path) -> None:  # noqa: D102
        if self.is_empty:
            require_free_folder(value, f"--{name}")
        if value.exists() and not value.is_dir():
            raise InvalidValueError(f"{name} is '{value}', a file; name a folder.")
        _require_place(name, value)


@final
@dataclass(frozen=True)
class InputFile(Requirement):
    """A file that is there."""

    def require(self, name: str, value: Path) -> None:  # noqa: D102
        if not value.is_file():
            found = "a folder; name a file in it" if value.is_dir() else "which is not there"
            found = "a pipe or a device; name a file" if value.exists() and not value.is_dir() else found
            raise InvalidValueError(f"{name} is '{value}', {found}.")


Count = Annotated[int, Within(1, 10_000_000)]
"""How many of something."""
Seed = Annotated[int, Within(0, 2**32 - 1)]
"""Seed of a random generator."""
Port = Annotated[int, Within(1, 65_535)]
"""Number of a TCP port."""
Share = Annotated[float, Within(0.0, 1.0)]
"""A part of something."""
Positive = Annotated[float, Above(0.0)]
"""A number greater than 0."""
AtMostFull = Annotated[float, Above(0.0, 1.0)]
"""A factor on a speed that may be lowered."""
NotNegative = Annotated[float, Within(0.0)]
"""A number that is 0 or more."""
PhysicsRate = Annotated[float, Within(30.0, 30_000.0), MultipleOf(30.0)]
"""Physics steps in a second, a multiple of the control rate."""
Range = Annotated[tuple[float, float], InOrder()]
"""Smallest and largest number of a uniform draw."""
Amount = float | Range
"""A number, or the range from which every episode draws its own, uniformly."""
Device = Annotated[str, Matching(r"cpu|cuda(:\d{1,3})?", "cpu, cuda, or cuda:1 and so on")]
"""Where something is computed."""
NewFolder = Annotated[Path, OutputFolder(is_empty=True)]
"""A folder for results, which is made or empty."""
ResultsFolder = Annotated[Path, OutputFolder()]
"""A folder for results, in which there may be some."""
FilmPath = Annotated[Path, OutputFile((".mp4", ".webp", ".gif", ".png"))]
"""A film to write, or stills of it."""
DynamicsPath = CameraPath = Annotated[Path, InputFile()]
"""Files that `identify` and `calibrate` write."""
RobotModelPath = Annotated[Path, InputFile()]
"""A maker's model of a part of the robot, URDF or MJCF."""


def require_valid(values: Any, path: str = "") -> None:
    """Check all fields of a dataclass, and those of dataclasses in it, against their declared types.

    Errors name a field by its path, such as `env.randomization.friction`.

    Args:
        values: The dataclass.
        path: Name of the dataclass itself; empty at the top.

    Raises:
        InvalidValueError: A value is of another type, outside its range, or in the wrong order.
    """
    for name, kind in _kinds(type(values)).items():
        require(kind, f"{path}.{name}" if path else name, getattr(values, name))


def require(kind: Any, name: str, value: Any) -> None:
    """Check a value against a declared type.

    Raises:
        InvalidValueError: The value is of another type, outside its range, or in the wrong order.
    """
    kind, requirements = _parts(kind)
    if not _fits(kind, value):
        raise InvalidValueError(f"{name} is {value!r:.200}; it must be {_in_words(kind)}.")
    if get_origin(kind) in (Union, UnionType):
        require(next(each for each in get_args(kind) if _fits(each, value)), name, value)
    elif is_dataclass(value):
        require_valid(value, name)
    elif isinstance(value, tuple | Mapping):
        _require_entries(kind, name, value)
    else:
        _require_representable(name, value)
    for requirement in requirements if value is not None else ():
        requirement.require(name, value)


def _require_entries(kind: Any, name: str, values: tuple[Any, ...] | Mapping[Any, Any]) -> None:
    if isinstance(values, Mapping):
        for key, value in values.items():
            require(get_args(kind)[1] if get_args(kind) else Any, f"{name}.{key}", value)
        return
    for index, (entry, value) in enumerate(zip(_entries(kind, len(values)), values, strict=True)):
        require(entry, f"{name}[{index}]" if is_dataclass(value) else name, value)


def _require_representable(name: str, value: Any) -> None:
    """Refuse a float that is not finite, and an integer of more than 64 bits."""
    if isinstance(value, float) and not math.isfinite(value):
        raise InvalidValueError(f"{name} is {value}; it must be a finite number.")
    if isinstance(value, int) and abs(value) >= 2**63:
        raise InvalidValueError(f"{name} is {_shown(value)}; it must be smaller.")


@cache
def _kinds(declared: type) -> dict[str, Any]:
    kinds = typing.get_type_hints(declared, include_extras=True)
    return {field.name: kinds[field.name] for field in fields(declared)}


def _parts(kind: Any) -> tuple[Any, tuple[Requirement, ...]]:
    found = getattr(kind, "__metadata__", ())
    return kind.__origin__ if found else kind, tuple(each for each in found if isinstance(each, Requirement))


def _entries(kind: Any, count: int) -> tuple[Any, ...]:
    kinds = get_args(kind)
    return kinds[:1] * count if kinds[-1:] == (Ellipsis,) else kinds or (Any,) * count


PLAIN = {
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
    bool: (bool, "True or False"),
    str: (str, "a text"),
    Path: (Path, "a path"),
    NoneType: (NoneType, "None"),
}
"""Types that are checked: what their values are instances of, and how messages call them."""


def _fits(kind: Any, value: Any) -> bool:
    """Return whether a value is of a declared type; unknown types hold anything."""
    kind, origin = _parts(kind)[0], get_origin(_parts(kind)[0])
    if kind in PLAIN:
        return isinstance(value, PLAIN[kind][0]) and isinstance(value, bool) is (kind is bool)
    if origin in (Union, UnionType):
        return any(_fits(each, value) for each in get_args(kind))
    if origin is Literal:
        return value in get_args(kind)
    if origin is tuple:
        return isinstance(value, tuple) and len(_entries(kind, len(value))) == len(value)
    if origin in (dict, Mapping):
        return isinstance(value, Mapping)
    return not (isinstance(kind, type) and is_dataclass(kind)) or isinstance(value, kind)


def _in_words(kind: Any) -> str:
    kind, origin, inner = _parts(kind)[0], get_origin(_parts(kind)[0]), get_args(_parts(kind)[0])
    if origin in (Union, UnionType):
        return " or ".join(map(_in_words, inner))
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin is tuple:
        return "a tuple" if inner[-1:] == (Ellipsis,) else f"a tuple of {len(inner)} entries"
    return PLAIN[kind][1] if kind in PLAIN else getattr(kind, "__name__", str(kind))


def _numbers(value: Any) -> tuple[float, ...]:
    return tuple(n for each in value for n in _numbers(each)) if isinstance(value, tuple) else (value,)


def _shown(number: float) -> str:
    if isinstance(number, int):
        return str(number) if abs(number) < 10**5 else f"{number:,}" if abs(number) < 10**15 else "huge"
    return f"{number:g}"


def _require_place(name: str, folder: Path) -> None:
    """Refuse a folder that is not there and cannot be made, or in which nothing can be written."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise InvalidValueError(f"{name}: nothing can be written in '{there}'; choose another place.")
