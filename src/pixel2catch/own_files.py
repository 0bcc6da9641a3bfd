"""Python files of one's own: what they define at their top level joins the package's catalogues.

`pixel2catch --import FILE.py COMMAND ...` names a file; `FILE.py:NAME`, wherever a command takes a name, does
so, too, and says what is meant in it. A value of a catalogue's type (a method, an object, a work cell, an
axis of disturbances) is known by its `name` from then on, also to the processes that a command starts.
"""

import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Any, TypeVar

from pixel2catch.errors import InvalidValueError, Pixel2CatchError

OPTION = "--import"
VARIABLE = "PIXEL2CATCH_IMPORT"
"""Environment variable with the files, separated as in PATH: how child processes come to know them."""

_NAME_IN_FILE = re.compile(r"(?P<option>--[\w.-]+=)?(?P<file>.+\.py):(?P<name>[^:/\\]+)")
_MODULES: dict[str, ModuleType] = {}  # what was imported, by path
_CATALOGUES: list["_Catalogue"] = []

Value = TypeVar("Value")


def take_option(args: Sequence[str]) -> list[str]:
    """Return arguments without `--import FILE.py`, and names for `FILE.py:NAME`; `VARIABLE` gets the files.

    Raises:
        InvalidValueError: The option names no file.
    """
    rest: list[str] = []
    remaining = iter(args)
    for argument in remaining:
        name, _, value = argument.partition("=")
        if name == OPTION:
            if not (file := value or next(remaining, "")):
                raise InvalidValueError(f"{OPTION} needs a Python file behind it, such as {OPTION} mine.py.")
            announce(file)
        else:
            rest.append(named(argument))
    return rest


def named(argument: str) -> str:
    """The name in `FILE.py:NAME`, or in `--option=FILE.py:NAME`, whose file is announced; else as it is."""
    found = _NAME_IN_FILE.fullmatch(argument)
    if not found:
        return argument
    announce(found["file"])
    return (found["option"] or "") + found["name"]


def announce(file: str) -> None:
    """Add a file to those that `import_files` imports, here and in child processes."""
    files = _announced()
    path = str(Path(file).absolute())
    if path not in files:
        os.environ[VARIABLE] = os.pathsep.join([*files, path])


def import_files() -> None:
    """Import the files that `VARIABLE` names, each once.

    Raises:
        InvalidValueError: If one cannot be imported by its name, or a name in it is taken.
    """
    for name in _announced():
        import_file(name)


def import_file(name: str) -> ModuleType:
    """Import a file, once; what it defines joins the catalogues.

    Raises:
        InvalidValueError: If it cannot be imported by its name, or a name in it is taken.
    """
    path = Path(name).absolute()
    if str(path) in _MODULES:
        return _MODULES[str(path)]
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if not path.is_file() or path.stem in sys.modules or spec is None or spec.loader is None:
        raise InvalidValueError(
            f"cannot import '{name}'; it must be a Python file, FILE.py, named like no module in use."
        )
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[path.stem]
        if isinstance(error, Pixel2CatchError) or not isinstance(error, Exception | SystemExit):
            raise
        lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
        where = f" in line {lines[-1]}" if lines else ""
        raise InvalidValueError(
            f"'{name}' cannot be imported: {type(error).__name__}{where}: {error}; correct it."
        ) from error
    for each in _CATALOGUES:
        each.join(module)
    _MODULES[str(path)] = module
    return module


def catalogue(kind: type[Value], values: dict[str, Value]) -> dict[str, Value]:
    """The package's values of a type by name, which those of files of one's own join; they have a `name`."""
    found = _Catalogue(kind=kind, values=values, of_package=frozenset(values))
    _CATALOGUES.append(found)
    for module in _MODULES.values():
        found.join(module)
    return values


def add(value: Any) -> str:
    """Put a value into its catalogue, in place of an own one that has its name, and return the name.

    Raises:
        InvalidValueError: If the package has another one of that name.
    """
    for each in _CATALOGUES:
        if isinstance(value, each.kind):
            each.add(value)
    return value.name


def defined(module: ModuleType, kind: type[Value]) -> Iterator[Value]:
    """The values of a type at the top level of a module, alone or in a tuple, in their order."""
    for value in tuple(vars(module).values()):
        values = value if isinstance(value, tuple) else (value,)
        yield from (each for each in values if isinstance(each, kind))


@dataclass(frozen=True, kw_only=True)
class _Catalogue:
    kind: type  #: Type of its values.
    values: dict[str, Any]  #: They by name.
    of_package: frozenset[str]  #: Names that are taken.

    def join(self, module: ModuleType) -> None:
        for value in defined(module, self.kind):
            self.add(value)

    def add(self, value: Any) -> None:
        if value.name in self.of_package and self.values[value.name] != value:
            raise InvalidValueError(
                f"the package has another {self.kind.__name__} called '{value.name}'; rename yours."
            )
        self.values[value.name] = value


def _announced() -> list[str]:
    return [file for file in os.environ.get(VARIABLE, "").split(os.pathsep) if file]
