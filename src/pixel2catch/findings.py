"""Results of checks of an installation or a laboratory.

A probe returns what it found, or raises an error that states the problem and the fix.
"""

from collections.abc import Callable
from dataclasses import dataclass

from pixel2catch.errors import Pixel2CatchError
from pixel2catch.installation import install_command


class Absent(Exception):  # noqa: N818
    """Something optional is missing; the message states its purpose and how to get it."""


class Broken(Exception):  # noqa: N818
    """Something does not work; the message states the fix."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """Result of a probe."""

    name: str  #: What was checked.
    state: str  #: good, BAD, or absent: optional and missing.
    found: str  #: What was found, or the problem and the fix.
    is_needed: bool  #: Whether `catch`, `evaluate` or a given option needs it.


def check(name: str, probe: Callable[[], str], *, is_needed: bool = False) -> Check:
    """Run a probe and return its result or its error."""
    try:
        state, found = "good", probe()
    except Absent as error:
        state, found = "absent", str(error)
    except (Broken, Pixel2CatchError) as error:
        state, found = "BAD", str(error)
    except Exception as error:  # a broken installation can raise anything
        state, found = "BAD", f"{type(error).__name__}: {error}: install anew, {install_command()} --upgrade"
    return Check(name=name, state=state, found=found, is_needed=is_needed)
