"""Count the files of the package whose functions run in a piece of work."""

import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType, FunctionType

import pixel2catch
from pixel2catch.servo.laws import entry

PACKAGE = Path(pixel2catch.__file__).parent
BUDGETS = tomllib.loads(Path(__file__).parents[1].joinpath("budgets.toml").read_text(encoding="utf-8"))


class FileCounter:
    """Counts files in all threads while it is switched on.

    A compiled entry counts with all functions that it refers to, once it was called. What runs while a module
    is imported does not count. Child processes do not count.
    """

    def __init__(self) -> None:
        self._codes: dict[CodeType, bool] = {}

    @contextmanager
    def switched(self, *, on: bool) -> Iterator[None]:
        """Count, or do not count, in this context; contexts may be nested."""
        before, function = sys.getprofile(), self._on_event if on else None
        for each in (threading.setprofile, sys.setprofile):
            each(function)  # type: ignore[arg-type]
        try:
            yield
        finally:
            for each in (threading.setprofile, sys.setprofile):
                each(before)  # type: ignore[arg-type]

    def files(self) -> set[str]:
        """Return the counted files, relative to the package."""
        codes = {code for code, is_counted in self._codes.items() if is_counted}
        if entry.__call__.__code__ in codes:
            for compiled in _compiled_entries():
                codes |= _referred(compiled, set())
        paths = {Path(code.co_filename) for code in codes}
        return {str(path.relative_to(PACKAGE)) for path in paths if path.is_relative_to(PACKAGE)}

    def _on_event(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and not self._codes.get(code) and code.co_filename.startswith(f"{PACKAGE}/"):
            self._codes[code] = not _is_import(frame)


def files_run(function: Callable[[], object]) -> set[str]:
    """Return the files, relative to the package, whose functions run in a call of the function."""
    counter = FileCounter()
    with counter.switched(on=True):
        function()
    return counter.files()


def _is_import(frame: FrameType | None) -> bool:
    """Return whether the top level of a module of the package called a frame."""
    while frame is not None:
        if frame.f_code.co_name == "<module>" and frame.f_code.co_filename.startswith(f"{PACKAGE}/"):
            return True
        frame = frame.f_back
    return False


def _compiled_entries() -> list[FunctionType]:
    """Return the entries of the servo's laws that were compiled, as Python functions."""
    modules = [module for name, module in sys.modules.items() if name.startswith("pixel2catch.")]
    values = [value for module in modules for value in vars(module).values() if isinstance(value, entry)]
    return [value.python for value in values if value.dispatcher is not None]


def _referred(function: FunctionType, known: set[CodeType]) -> set[CodeType]:
    """Return the code of a compiled function and of all functions that it refers to."""
    if function.__code__ in known:
        return known
    known.add(function.__code__)
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    for other in (*cells, *(function.__globals__.get(name) for name in function.__code__.co_names)):
        if isinstance(other, FunctionType):
            _referred(other, known)
    return known
