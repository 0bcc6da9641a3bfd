"""What values must be, declared at the fields of configurations and options and checked in one place."""

import math
import os
import re
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache, wraps
from inspect import Parameter, signature
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, final, get_args, get_origin

from pixel2catch.errors import InvalidValueError

Given = ParamSpec("Given")
Result = TypeVar("Result")

LARGEST = 1e12  #: Largest number where a field states no other bound.


class Requirement(ABC):
    """A condition on a value, as a part of its type: `Annotated[int, Within(1, 9)]`."""

    @abstractmethod
    def require(self, name: str, value: Any) -> None:
        """Raise InvalidValueError if the value of the field with this name does not meet the condition."""


@final
@dataclass(frozen=True)
class Within(Requirement):
    """A number, or each number of a tuple, between two bounds."""

    low: float
    high: float = LARGEST
    is_open: bool = False  #: Whether the lower bound itself is excluded; the upper one is included.

    def require(self, name: str, value: Any) -> None:  # noqa: D102 (documented in the interface)
        for number in _numbers(value):
            if not self.low <= number <= self.high or (self.is_open and number == self.low):
                words = "greater than {}, and at most {}" if self.is_open else "from {} to {}"
                valid = words.format(_shown(self.low), _shown(self.high))
                raise InvalidValueError(f"{name} is {_shown(number)}; it must be {valid}.")


@final
@dataclass(frozen=True)
class Meets(Requirement):
    """A value for which a test holds."""

    test: Callable[[Any], Any]
    fix: str  #: What the message says to do.

    def require(self, name: str, value: Any) -> None:  # noqa: D102
        if not self.test(value):
            raise InvalidValueError(f"{name} is {_shown(value)}; {self.fix}.")


IN_ORDER = Meets(lambda pair: pair[0] <= pair[1], "give the smaller number first")
"""A tuple whose first two numbers do not fall."""
NOT_EMPTY = Meets(bool, "give at least one value")
NAME = Meets(re.compile(r"[\w.+-]{1,100}").fullmatch, "use up to 100 letters, digits, '_', '.', '+' and '-'")
NAMED = Meets(lambda function: hasattr(function, "__name__"), "define it by def, which gives it a name")
UNIT_LENGTH = Meets(lambda numbers: abs(math.hypot(*numbers) - 1.0) <= 1e-3, "it must have length 1")


@final
@dataclass(frozen=True)
class InputFile(Requirement):
    """A file that is there."""

    names: tuple[str, ...] = ()  #: Names that stand for a file where there is none of this name.

    def require(self, name: str, value: Path) -> None:  # noqa: D102
        if not value.is_file() and (value.exists() or str(value) not in self.names):
            found = "a folder; name a file in it" if value.is_dir() else "a pipe or a device; name a file"
            found = found if value.exists() else "which is not there"
            raise InvalidValueError(f"{name} is '{value}', {found}.")


@final
@dataclass(frozen=True)
class OutputFile(Requirement):
    """A file that can be written; its folder is made later."""

    endings: tuple[str, ...] = ()  #: Valid endings of its name, such as .mp4; all if empty.
    is_new: bool = False  #: Whether it must not be there yet.

    def require(self, name: str, value: Path) -> None:  # noqa: D102
        if self.endings and value.suffix.lower() not in self.endings:
            valid = " or ".join(self.endings)
            raise InvalidValueError(f"{name} is '{value}'; end the file's name in {valid}.")
        if value.exists():
            InputFile().require(name, value)
            if self.is_new or not os.access(value, os.W_OK):
                found = "exists" if self.is_new else "cannot be written"
                raise InvalidValueError(f"{name} is '{value}', which {found}; name another file.")
        _require_place(name, value.parent)


@final
@dataclass(frozen=True)
class OutputFolder(Requirement):
    """A folder that is there, or can be made."""

    is_empty: bool = False  #: Whether nothing may be in it.

    def require(self, name: str, value: Path) -> None:  # noqa: D102
        if self.is_empty and value.exists() and (not value.is_dir() or any(value.iterdir())):
            raise InvalidValueError(f"{name} is '{value}', which is not an empty folder; name another.")
        if value.is_file():
            raise InvalidValueError(f"{name} is '{value}', a file; name a folder.")
        _require_place(name, value)


def _require_place(name: str, folder: Path) -> None:
    """Raise InvalidValueError if nothing can be written in a folder, which may have to be made."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(path))
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise InvalidValueError(f"{name}: nothing can be written in '{there}'; choose another place.")


Count = Annotated[int, Within(1, 10_000_000)]  #: How many of something.
Seed = Annotated[int, Within(0, 2**32 - 1)]  #: Seed of a random generator.
Share = Annotated[float, Within(0.0, 1.0)]  #: A part of something.
Positive = Annotated[float, Within(0.0, is_open=True)]
Fraction = Annotated[float, Within(0.0, 1.0, is_open=True)]  #: A factor that lowers a speed.
NotNegative = Annotated[float, Within(0.0)]
Range = Annotated[tuple[float, float], IN_ORDER]  #: Smallest and largest number of a uniform draw.
Amount = float | Range  #: A number, or the range from which every episode draws its own, uniformly.

CONTROL_RATE_MULTIPLE = Meets(
    lambda rate: abs(rate / 30.0 - round(rate / 30.0)) < 1e-6, "it must be a multiple of 30"
)
PhysicsRate = Annotated[float, Within(30.0, 30_000.0), CONTROL_RATE_MULTIPLE]  #: Physics steps in a second.
DEVICE = Meets(re.compile(r"cpu|cuda(:\d{1,3})?").fullmatch, "it must be cpu, cuda, or cuda:1 and so on")
Device = Annotated[str, DEVICE]  #: Where something is computed.
JOB_OPTION = Meets(re.compile(r"\w+=\S+").fullmatch, "it must be NAME=VALUE, such as timeout_min=60")
JobOptions = Annotated[tuple[Annotated[str, JOB_OPTION], ...], NOT_EMPTY]
"""What each job of a cluster asks for, by names of submitit."""

NewFolder = Annotated[Path, OutputFolder(is_empty=True)]  #: A folder for results, which is made or empty.
ResultsFolder = Annotated[Path, OutputFolder()]  #: A folder for results, in which there may be some.
FilmPath = Annotated[Path, OutputFile((".mp4", ".webp", ".gif", ".png"))]  #: A film to write, or its stills.
CAMERA_NAMES = ("release", "people")  #: Cameras that a name stands for: `scene.constants.CAMERAS`.
DynamicsPath = Annotated[Path, InputFile()]  #: File that `identify` writes.
CameraPath = Annotated[Path, InputFile(CAMERA_NAMES)]  #: File that `calibrate` writes, or such a name.


def require_valid(values: Any, path: str = "") -> None:
    """Check all fields of a dataclass, and those of dataclasses in it, against their declared types.

    InvalidValueError names a field by its path, such as `env.randomization.friction`, behind `path`.
    """
    for each in _fields(values, path):
        require(*each)


def require(kind: Any, name: str, value: Any) -> None:
    """Check a value against a declared type; raise as `require_valid` does."""
    kind, requirements = _parts(kind)
    if not _fits(kind, value):
        raise InvalidValueError(f"{name} is {value!r:.200}; it must be {_in_words(kind)}.")
    bounds = [bound for each in requirements if isinstance(each, Within) for bound in (each.low, each.high)]
    if isinstance(value, float) and not math.isfinite(value) and value not in bounds:
        raise InvalidValueError(f"{name} is {value}; it must be a finite number.")
    if isinstance(value, int) and abs(value) >= 2**63:  # readers use 64 bits
        raise InvalidValueError(f"{name} is {_shown(value)}; it must be smaller.")
    for each in _contents(kind, name, value):
        require(*each)
    for requirement in requirements if value is not None else ():
        requirement.require(name, value)


def require_used(values: Any, names: Sequence[str], is_used: bool, when: str) -> None:
    """Raise InvalidValueError for fields of a dataclass that are not used and have not their defaults."""
    for field in fields(values) if not is_used else ():
        default = field.default if field.default_factory is MISSING else field.default_factory()
        if field.name in names and (value := getattr(values, field.name)) != default:
            name = f"{field.name} is {_shown(value)}"
            raise InvalidValueError(f"{name}, which does nothing {when}; change one of the two.")


def require_only(values: Any, names: Sequence[str], when: str) -> None:
    """Raise as `require_used` does for all other fields, and for those of dataclasses in it."""
    for field in fields(values):
        value, is_used = getattr(values, field.name), field.name in names
        if is_dataclass(value) and not is_used:
            require_only(value, names, when)
        else:
            require_used(values, (field.name,), is_used, when)


def typed(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Return a function that refuses arguments of another type than it declares."""

    @wraps(function)
    def checked(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        kinds = typing.get_type_hints(function, include_extras=True)
        bound = signature(function).bind(*args, **kwargs)
        for name, value in bound.arguments.items():
            is_several = bound.signature.parameters[name].kind is Parameter.VAR_POSITIONAL
            require(tuple[kinds[name], ...] if is_several else kinds.get(name, Any), name, value)
        return function(*args, **kwargs)

    return checked


def _contents(kind: Any, name: str, value: Any) -> Iterator[tuple[Any, str, Any]]:
    """Yield what a value consists of: declared types, names and values."""
    if get_origin(kind) in (Union, UnionType):
        yield next(each for each in get_args(kind) if _fits(each, value)), name, value
    elif is_dataclass(value):
        yield from _fields(value, name)
    elif isinstance(value, Mapping):
        inner = get_args(kind)[1] if get_args(kind) else Any
        yield from ((inner, f"{name}.{key}", entry) for key, entry in value.items())
    elif isinstance(value, tuple) and get_origin(kind) in (tuple, None):
        for index, (each, entry) in enumerate(zip(_entries(kind, len(value)), value, strict=True)):
            yield each, f"{name}[{index}]" if is_dataclass(each) else name, entry


def _fields(values: Any, path: str) -> Iterator[tuple[Any, str, Any]]:
    for name, kind in _kinds(type(values)).items():
        yield kind, f"{path}.{name}" if path else name, getattr(values, name)


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
    kind = _parts(kind)[0]
    origin = get_origin(kind)
    if kind in PLAIN:
        return isinstance(value, PLAIN[kind][0]) and isinstance(value, bool) is (kind is bool)
    if origin in (Union, UnionType):
        return any(_fits(each, value) for each in get_args(kind))
    if origin is Literal:
        return isinstance(value, str) and value in get_args(kind)
    if origin is tuple:
        return isinstance(value, tuple) and len(_entries(kind, len(value))) == len(value)
    if origin in (dict, Mapping):
        return isinstance(value, Mapping)
    if origin is Callable:
        return callable(value)
    if kind is Any or getattr(kind, "_is_protocol", False) or kind.__module__ == "jaxtyping":
        return True
    return not isinstance(kind, type) or isinstance(value, kind)


def _in_words(kind: Any) -> str:
    kind = _parts(kind)[0]
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(map(_in_words, inner))
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin is tuple:
        return "a tuple" if inner[-1:] == (Ellipsis,) else f"a tuple of {len(inner)} entries"
    if origin is Callable:
        return "a function"
    return PLAIN[kind][1] if kind in PLAIN else getattr(kind, "__name__", str(kind))


def _numbers(value: Any) -> tuple[float, ...]:
    return tuple(n for each in value for n in _numbers(each)) if isinstance(value, tuple) else (value,)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(_shown, value)) or "empty"
    if isinstance(value, str | Path):
        return f"'{value}'"
    if isinstance(value, int):
        return str(value) if abs(value) < 10**5 else f"{value:,}" if abs(value) < 10**15 else "huge"
    return f"{value:g}" if isinstance(value, Real) else f"{value!r:.200}"
