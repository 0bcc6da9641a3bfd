"""Python files of one's own, with methods or work cells: `pixel2catch --import FILE.py COMMAND ...`."""

import importlib.util
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from pixel2catch.errors import InvalidValueError

OPTION = "--import"
VARIABLE = "PIXEL2CATCH_IMPORT"
"""Environment variable with the files, separated as in PATH: how child processes come to know them."""


def take_option(args: Sequence[str]) -> list[str]:
    """The arguments without `--import FILE.py`; the files are added to `VARIABLE`."""
    rest: list[str] = []
    files = [os.environ[VARIABLE]] if os.environ.get(VARIABLE) else []
    remaining = iter(args)
    for argument in remaining:
        name, _, value = argument.partition("=")
        if name == OPTION:
            files.append(str(Path(value or next(remaining, "")).absolute()))
        else:
            rest.append(argument)
    if files:
        os.environ[VARIABLE] = os.pathsep.join(files)
    return rest


def import_files() -> list[ModuleType]:
    """Import the files that `VARIABLE` names, each once, and return them.

    Raises:
        InvalidValueError: If one cannot be imported by its name.
    """
    return [import_file(name) for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep))]


def import_file(name: str) -> ModuleType:
    """Import a file, once.

    Raises:
        InvalidValueError: If it cannot be imported by its name.
    """
    path = Path(name).absolute()
    known = sys.modules.get(path.stem)
    if known is not None and getattr(known, "__file__", None) == str(path):
        return known
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if not path.is_file() or known is not None or spec is None or spec.loader is None:
        raise InvalidValueError(
            f"cannot import '{name}'; it must be a Python file, FILE.py, named like no module in use."
        )
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
