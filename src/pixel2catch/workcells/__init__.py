"""Work cells by name: every module in here has some, and so may a file of one's own.

A new one is a new file that defines `WORKCELLS`; no other file changes.
"""

import importlib
import pkgutil
from functools import cache

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.own_files import OPTION, catalogue, defined, import_file, import_files
from pixel2catch.robots.workcell import WorkcellSpec


def workcells() -> dict[str, WorkcellSpec]:
    """All work cells that are known, by name: those of the package, and of files that were imported."""
    import_files()
    return _catalogue()


def find_workcell(name: str) -> WorkcellSpec:
    """The work cell of that name, or the last in the Python file with that path.

    Raises:
        UnknownNameError: With the valid names.
        InvalidValueError: If a file defines none, or cannot be imported.
    """
    if name.endswith(".py") and name not in workcells():
        found = list(defined(import_file(name), WorkcellSpec))
        if not found:
            raise InvalidValueError(f"{name} defines no WorkcellSpec at its top level; see CONTRIBUTING.md")
        return found[-1]
    return known_workcell(name)


def known_workcell(name: str) -> WorkcellSpec:
    """The work cell of that name, for files whose writer must not choose what Python runs.

    Raises:
        UnknownNameError: With the valid names.
    """
    known = workcells()
    if name not in known:
        raise UnknownNameError("work cell", name, (*known, f"or one of a file of your own, {OPTION} FILE.py"))
    return known[name]


@cache
def _catalogue() -> dict[str, WorkcellSpec]:
    modules = [
        importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)
    ]
    return catalogue(WorkcellSpec, {each.name: each for module in modules for each in module.WORKCELLS})
