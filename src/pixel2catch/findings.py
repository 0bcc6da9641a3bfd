"""What an examination finds: `doctor` makes a line of each, and its exit status of all.

A probe says what it found, or raises what is wrong and what to do.
"""

from collections.abc import Callable
from dataclasses import dataclass

from pixel2catch.errors import Pixel2CatchError
from pixel2catch.installation import install_command


class Absent(Exception):  # noqa: N818
    """Something optional is not there; the message says what it would be for and how to get it."""


class Broken(Exception):  # noqa: N818
    """Something is there and does not work; the message says what to do."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """What a probe found."""

    name: str  #: What was looked at.
    state: str  #: good, BAD, or absent: optional, and not there.
    found: str  #: What there is, or what is wrong and what to do.
    is_needed: bool  #: Whether `catch` and `evaluate`, or what was asked for by an option, need it.


def check(name: str, probe: Callable[[], str], *, is_needed: bool = False) -> Check:
    """Run a probe; whatever it raises becomes the result."""
    try:
        state, found = "good", probe()
    except Absent as error:
        state, found = "absent", str(error)
    except (Broken, Pixel2CatchError) as error:
        state, found = "BAD", str(error)
    except Exception as error:  # the reason why a doctor is asked may be anything
        state, found = "BAD", f"{type(error).__name__}: {error}: install anew, {install_command()} --upgrade"
    return Check(name=name, state=state, found=found, is_needed=is_needed)
