"""Python files of users: their methods, objects, work cells and axes of disturbances join the catalogues.

`pixel2catch --import FILE.py COMMAND ...` imports a file. Values at its top level are found by their
`name`, also in child processes.
"""

import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Any, TypeVar

from pixel2catch.errors import InvalidValueError, Pixel2CatchError

OPTION = "--import"
VARIABLE = "PIXEL2CATCH_IMPORT"
"""Environment variable with the files, separated as in PATH, for child processes."""

_MODULES: dict[str, ModuleType] = {}  # imported modules, by path
_CATALOGUES: dict[type, tuple[dict[str, Any], frozenset[str]]] = {}
# values by name, and the names of the package's values, by type

Value = TypeVar("Value")


def take_option(args: Sequence[str]) -> list[str]:
    """Return arguments without `--import FILE.py`; `VARIABLE` gets the files."""
    rest: list[str] = []
    remaining = iter(args)
    for argument in remaining:
        name, _, value = argument.partition("=")
        if ".py:" in argument:
            raise InvalidValueError(f"'{argument}': give {OPTION} FILE.py, and the name alone.")
        if name != OPTION:
            rest.append(argument)
        elif file := value or next(remaining, ""):
            files = dict.fromkeys([*announced(), str(Path(file).absolute())])
            os.environ[VARIABLE] = os.pathsep.join(files)  # for child processes, too
        else:
            raise InvalidValueError(f"{OPTION} needs a Python file behind it, such as {OPTION} mine.py.")
    return rest


def import_files() -> None:
    """Import all announced files, each once; raise as `import_file` does."""
    for name in announced():
        import_file(name)


def import_file(name: str) -> None:
    """Import a file once and add its values to the catalogues, or raise InvalidValueError."""
    path = Path(name).absolute()
    if str(path) in _MODULES:
        return
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if not path.is_file() or path.stem in sys.modules or spec is None or spec.loader is None:
        raise InvalidValueError(f"'{name}' must be a Python file, FILE.py, named like no module in use.")
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[path.stem]
        raise InvalidValueError(f"'{name}' cannot be imported: {in_words(error)}; correct it.") from error
    for kind in _CATALOGUES:
        _add_all(module, kind)
    _MODULES[str(path)] = module


def catalogue(kind: type[Value], values: dict[str, Value], taken: Iterable[str] = ()) -> dict[str, Value]:
    """Return the package's values of a type, by name; user files add others, not `taken`."""
    _CATALOGUES[kind] = values, frozenset((*values, *taken))
    for module in _MODULES.values():
        _add_all(module, kind)
    return values


def add(value: Any) -> str:
    """Add a value to its catalogue, replace a user's value of the same name, and return the name."""
    for kind, (values, of_package) in _CATALOGUES.items():
        if isinstance(value, kind):
            if value.name in of_package and values.get(value.name) != value:
                raise InvalidValueError(f"{kind.__name__} '{value.name}' is in the package; rename yours.")
            values[value.name] = value
    return value.name


def _add_all(module: ModuleType, kind: type) -> None:
    """Add the values of a type at the top level of a module, alone or in a tuple or list, in order."""
    for value in tuple(vars(module).values()):
        for each in value if isinstance(value, tuple | list) else (value,):
            if isinstance(each, kind):
                add(each)


def computed(
    kind: str, term: Callable[..., Any], given: Sequence[Any], *shape: int | str, is_blank: bool = False
) -> Any:
    """Return what a term, such as one of the user, computes: numbers in a shape, where a text is any size.

    They must be finite, unless what is given is blank. An InvalidValueError names the term and its file.
    """
    code = getattr(inspect.unwrap(term), "__code__", None)
    name = f"{kind} '{getattr(term, '__name__', term)}'"
    name += f" ('{code.co_filename}', line {code.co_firstlineno})" if code else ""
    try:
        value = term(*given)
    except Exception as error:
        raise InvalidValueError(f"{name}: {in_words(error)}; correct it.") from error
    if not hasattr(value, "isfinite") or value.is_complex():
        raise InvalidValueError(f"{name} returns {value!r:.200}; it must return a tensor of real numbers.")
    sizes = zip(shape, found := tuple(value.shape), strict=False)
    if len(shape) != len(found) or any(size not in (there, "any") for size, there in sizes):
        words = ", ".join(map(str, shape))
        raise InvalidValueError(f"{name} returns the shape {found}; it must be ({words}).")
    if not is_blank and not value.isfinite().all():
        raise InvalidValueError(f"{name} returns NaN or infinity; it must return finite numbers.")
    return value


def place_of(error: BaseException) -> str:
    """Return function, file and line of the user's that an error comes from; nothing if from no such file."""
    passed = [each for each in extract_tb(error.__traceback__) if each.filename in announced()]
    return "'{0.name}' ('{0.filename}', line {0.lineno}): ".format(passed[-1]) if passed else ""


def in_words(error: BaseException) -> str:
    """Return what an error says, behind its place in a file of the user, and its type if it is not ours."""
    kind = "" if isinstance(error, Pixel2CatchError) else f"{type(error).__name__}: "
    return f"{place_of(error)}{kind}{error}".rstrip(".")


def announced() -> list[str]:
    """Return the files that `import_files` imports."""
    return [file for file in os.environ.get(VARIABLE, "").split(os.pathsep) if file]
