"""Work cells by name: every module in here has some, and so may a file of one's own.

A new one is a new file that defines `WORKCELLS`; no other file changes.
"""

import importlib
import importlib.util
import pkgutil
from pathlib import Path
from types import ModuleType

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.robots.workcell import WorkcellSpec

_FOUND: dict[str, WorkcellSpec] = {}


def workcells() -> dict[str, WorkcellSpec]:
    """All work cells that are known, by name: those of the package, and those of files that were read."""
    if not _FOUND:
        for module in pkgutil.iter_modules(__path__):
            _add(importlib.import_module(f"{__name__}.{module.name}"))
    return _FOUND


def find_workcell(name: str) -> WorkcellSpec:
    """The work cell of that name, or the first in a Python file.

    Args:
        name: A name, or the path of a file that defines `WORKCELLS`.

    Raises:
        UnknownNameError: With the valid names.
        InvalidValueError: If a file defines none, or cannot be run.
    """
    known = workcells()
    if name in known:
        return known[name]
    if name.endswith(".py"):
        return _add(_module(Path(name)))
    raise UnknownNameError("work cell", name, (*known, "or a file of your own, PATH.py"))


def _add(module: ModuleType) -> WorkcellSpec:
    """Make the work cells of a module known, and return the first."""
    found = getattr(module, "WORKCELLS", ())
    if not found or not all(isinstance(each, WorkcellSpec) for each in found):
        raise InvalidValueError(f"{module.__file__} defines no WORKCELLS, a tuple of WorkcellSpec")
    _FOUND.update({each.name: each for each in found})
    return found[0]


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.exists():
        raise InvalidValueError(f"there is no file '{path}'")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InvalidValueError(f"cannot run '{path}': {type(error).__name__}: {error}") from error
    return module
