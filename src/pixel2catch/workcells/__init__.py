"""Work cells by name: those of every module in this folder, and of Python files that were imported.

A new one is a new file that defines `WORKCELLS`; no other file changes.
"""

import importlib
import pkgutil

from pixel2catch.errors import UnknownNameError
from pixel2catch.own_files import OPTION, catalogue, import_files
from pixel2catch.robots.workcell import WorkcellSpec

_MODULES = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
_KNOWN = catalogue(WorkcellSpec, {each.name: each for module in _MODULES for each in module.WORKCELLS})


def workcells() -> dict[str, WorkcellSpec]:
    """Return all work cells by name: those of the package, and of files that were imported."""
    import_files()
    return _KNOWN


def find_workcell(name: str) -> WorkcellSpec:
    """Return the work cell of a name; raise UnknownNameError for another."""
    if name not in _KNOWN and name not in workcells():
        raise UnknownNameError("work cell", name, (*_KNOWN, f"or one of your own, {OPTION} FILE.py"))
    return _KNOWN[name]
