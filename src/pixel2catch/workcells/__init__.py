"""Work cells by name: every module in here has some, and so may a file of one's own.

A new one is a new file that defines `WORKCELLS`; no other file changes.
"""

import importlib
import pkgutil
from types import ModuleType

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.own_files import OPTION, import_file, import_files
from pixel2catch.robots.workcell import WorkcellSpec

_FOUND: dict[str, WorkcellSpec] = {}


def workcells() -> dict[str, WorkcellSpec]:
    """All work cells that are known, by name: those of the package, and of files that were imported."""
    if not _FOUND:
        for module in pkgutil.iter_modules(__path__):
            _add(importlib.import_module(f"{__name__}.{module.name}"))
    for module in import_files():
        if hasattr(module, "WORKCELLS"):
            _add(module)
    return _FOUND


def find_workcell(name: str) -> WorkcellSpec:
    """The work cell of that name, or the first in the Python file with that path.

    Raises:
        UnknownNameError: With the valid names.
        InvalidValueError: If a file defines none, or cannot be imported.
    """
    known = workcells()
    if name in known:
        return known[name]
    if name.endswith(".py"):
        return _add(import_file(name))
    raise UnknownNameError("work cell", name, (*known, f"or one of a file of your own, {OPTION} FILE.py"))


def _add(module: ModuleType) -> WorkcellSpec:
    """Make the work cells of a module known, and return the first."""
    found = getattr(module, "WORKCELLS", ())
    if not found or not all(isinstance(each, WorkcellSpec) for each in found):
        raise InvalidValueError(f"{module.__file__} defines no WORKCELLS, a tuple of WorkcellSpec")
    _FOUND.update({each.name: each for each in found})
    return found[0]
