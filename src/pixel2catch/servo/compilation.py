"""Compilation of the servo's laws with numba: loops over joints take a tenth of the time of array code.

Numba is imported at the first call of an entry. Compiled code is kept in a folder named by a hash of all
sources, beside these or in the user's cache. Where no folder can be written, each process compiles anew.
"""

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, final

Record = Any  #: An entry of a structured array; numba checks its fields when it compiles.
Records = Any  #: A structured array, with an entry for each robot or joint.

F = TypeVar("F", bound=Callable[..., object])

USER_CACHE = Path("~/.cache/pixel2catch")  #: Where compiled code is kept if the package is read-only.
_LAWS: list[Callable[..., object]] = []


def compiled(function: F) -> F:
    """Mark a function that entries call: they compile it; all other callers run it in Python.

    Results equal those of Python and NumPy to the last bit, NaN included: no `fastmath`.
    """
    _LAWS.append(function)
    return function


@final
class entry:  # noqa: N801
    """Decorator: compile a function, and all that it calls, for the types of its first call."""

    def __init__(self, function: Callable[..., object]) -> None:
        """Compile nothing yet."""
        self.python, self.dispatcher = function, None

    def __call__(self, *arguments: object) -> Any:
        """Run the compiled function.

        Raises:
            ImportError: At the first call: numba is missing.
            TypeError: The types differ from those of the first call.
        """
        self.dispatcher = self.dispatcher or _compile(self.python, arguments)
        return self.dispatcher(*arguments)


def _compile(function: Callable[..., object], arguments: tuple[object, ...]) -> Any:
    import numba
    import numba.extending

    config: Any = vars(numba)["config"]
    while _LAWS:
        numba.extending.register_jitable(error_model="numpy", no_cfunc_wrapper=True)(_LAWS.pop())
    types = [tuple(numba.typeof(argument) for argument in arguments)]
    if folder := _cache_folder(Path(function.__code__.co_filename)):
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        try:
            return numba.njit(types, cache=True, error_model="numpy", nogil=True)(function)
        except Exception:  # the disk is full, or a file is damaged
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            config.CACHE_DIR = before
    return numba.njit(types, error_model="numpy", nogil=True)(function)


def _cache_folder(source: Path) -> Path | None:
    """Return a writable folder for the code compiled from these sources; None if there is none."""
    with suppress(OSError):
        files = sorted({*Path(__file__).parent.glob("*.py"), *source.parent.glob("*.py")})
        name = f"servo-{sha256(b''.join(file.read_bytes() for file in files)).hexdigest()[:32]}"
        for base in (source.parent / "__pycache__", USER_CACHE.expanduser()):
            with suppress(OSError):
                (base / name).mkdir(parents=True, exist_ok=True)
                if os.access(base / name, os.W_OK):
                    return base / name
    return None
