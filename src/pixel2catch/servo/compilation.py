"""Laws of one robot as loops over its joints, compiled: one tick of arrays takes ten times as long.

Only what constructs a servo imports this, and with it numba. The compiled code is kept beside the source, as
bytecode is, or in the user's cache; where neither can be written it is compiled in every process.
"""

from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, final

import numba
import numba.extending
from numba.core.caching import FunctionCache, IndexDataCacheFile

Record = Any  #: An entry of a structured array; numba checks its fields when it compiles.
Records = Any  #: A structured array, an entry of a robot or of each of its joints.

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile a function where an `entry` calls it; called by anything else, it is Python.

    Numbers are those of Python and NumPy to the last bit, NaN included: no `fastmath`.
    """
    return numba.extending.register_jitable(error_model="numpy", no_cfunc_wrapper=True)(function)


def entry(function: Callable[..., object]) -> Any:
    """Compile a function and all that it calls at its first call, and keep that for other processes."""
    dispatcher: Any = numba.njit(error_model="numpy", nogil=True)(function)
    with suppress(RuntimeError, OSError):  # there is no place to keep it, or there are no sources
        dispatcher._cache = _Cache(function)
    return dispatcher


@final
class _Cache(FunctionCache):
    """Numba's cache, which would not see that a law in another file has changed.

    Its files are named after all sources, of this folder and of the function: whatever interrupts their
    writing, none is taken for what is compiled of others.
    """

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        sources = sorted({*Path(__file__).parent.glob("*.py"), Path(function.__code__.co_filename)})
        stamp = sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
        self._base = self._impl.filename_base
        self._cache_file = IndexDataCacheFile(self._cache_path, f"{self._base}.{stamp}", stamp)

    def load_overload(self, sig: object, target_context: object) -> object:
        """What is kept; nothing, and a new beginning, if that cannot be read, as after a loss of power."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:
            self._forget()
            return None

    def save_overload(self, sig: object, data: object) -> None:
        """Keep it in place of all that was kept, if there is room."""
        self._forget()
        with suppress(OSError):
            super().save_overload(sig, data)

    def _forget(self) -> None:
        for path in Path(self._cache_path).glob(f"{self._base}.*.nb[ic]"):
            with suppress(OSError):
                path.unlink()
