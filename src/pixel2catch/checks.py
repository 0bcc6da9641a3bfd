"""What values must be, declared at the fields of configurations and options and checked in one place."""

import math
import os
import re
import typing
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, final, get_args, get_origin

from pixel2catch.errors import InvalidValueError
from pixel2catch.files import require_free_file, require_free_folder


class Requirement(ABC):
    """What a value must be, as a part of its type: `Annotated[int, Within(1, 9)]`."""

    @abstractmethod
    def require(self, name: str, value: Any) -> None:
        """Raise if the value of the field by that name is not so.

        Raises:
            InvalidValueError: With the value, what is valid, and the fix.
        """


@final
@dataclass(frozen=True)
class Within(Requirement):
    """A number between two bounds, both included."""

    low: float
    high: float = math.inf

    def require(self, name: str, value: float) -> None:  # noqa: D102 (documented in the interface)
        if not self.low <= value <= self.high:
            bounds = f"from {_shown(self.low)} to {_shown(self.high)}"
            if self.high == math.inf:
                bounds = f"{_shown(self.low)} or more"
            raise InvalidValueError(f"{name} is {_shown(value)}; it must be {bounds}.")


@final
@dataclass(frozen=True)
class Above(Requirement):
    """A number greater than a bound, and at most another."""

    low: float
    high: float = math.inf

    def require(self, name: str, value: float) -> None:  # noqa: D102
        if not self.low < value <= self.high:
            most = "" if self.high == math.inf else f", and at most {_shown(self.high)}"
            raise InvalidValueError(
                f"{name} is {_shown(value)}; it must be greater than {_shown(self.low)}{most}."
            )


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
Domain = Annotated[int, Within(0, 232)]
"""Number of a DDS domain."""
Share = Annotated[float, Within(0.0, 1.0)]
"""A part of something."""
Positive = Annotated[float, Above(0.0)]
"""A number greater than 0."""
AtMostFull = Annotated[float, Above(0.0, 1.0)]
"""A factor on a speed that may be lowered."""
NotNegative = Annotated[float, Within(0.0)]
"""A number that is 0 or more."""
PhysicsRate = Annotated[float, Within(30.0, 30_000.0)]
"""Physics steps in a second."""
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


def require_valid(values: Any) -> None:
    """Check all fields of a dataclass, and those of dataclasses in it, against their types.

    What is not declared otherwise is checked, too: a float is a number, an integer fits into 64 bits.

    Raises:
        InvalidValueError: A value is not what its field's type says.
    """
    for name, kind in _kinds(type(values)).items():
        _require(kind, name, getattr(values, name))


@cache
def _kinds(declared: type) -> dict[str, Any]:
    """Types of the fields of a dataclass, by name."""
    kinds = typing.get_type_hints(declared, include_extras=True)
    return {field.name: kinds[field.name] for field in fields(declared)}


def _require(kind: Any, name: str, value: Any) -> None:
    origin = get_origin(kind)
    for requirement in getattr(kind, "__metadata__", ()) if value is not None else ():
        if isinstance(requirement, Requirement):
            requirement.require(name, value)
    if is_dataclass(value):
        require_valid(value)
    elif origin in (Annotated, Union, UnionType):
        for member in get_args(kind)[: 1 if origin is Annotated else None]:
            _require(member, name, value)
    elif isinstance(value, tuple):
        _require_entries(get_args(kind), name, value)
    else:
        _require_number(name, value)


def _require_number(name: str, value: Any) -> None:
    """Refuse a float that is no number, and an integer that nothing can hold."""
    if isinstance(value, float) and not math.isfinite(value):
        raise InvalidValueError(f"{name} is {value}; it must be a finite number.")
    if isinstance(value, int) and abs(value) >= 2**63:
        raise InvalidValueError(f"{name} is {_shown(value)}; it must be smaller.")


def _require_entries(kinds: tuple[Any, ...], name: str, values: tuple[Any, ...]) -> None:
    inner = kinds[:1] * len(values) if kinds[-1:] == (Ellipsis,) else kinds or (Any,) * len(values)
    for kind, value in zip(inner, values, strict=False):
        _require(kind, name, value)


def _shown(number: float) -> str:
    """A number for a message."""
    if isinstance(number, int):
        return str(number) if abs(number) < 10**5 else f"{number:,}" if abs(number) < 10**15 else "huge"
    return f"{number:g}"


def _require_place(name: str, folder: Path) -> None:
    """Refuse a folder that is not there and cannot be made, or in which nothing can be written."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise InvalidValueError(f"{name}: nothing can be written in '{there}'; choose another place.")
