"""Checks of an installation or a laboratory, and install commands."""

import importlib.metadata
import importlib.util
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from urllib.parse import unquote, urlparse

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from pixel2catch.errors import PerceptionError, Pixel2CatchError

PACKAGE = "pixel2catch"

GL_VARIABLE = "PIXEL2CATCH_GL"
"""Environment variable that holds MUJOCO_GL for commands and their processes; see `rendering.renderer`."""


def install_command(extra: str = "") -> str:
    """Return the command that installs this package, or the packages of an extra, from where it came from."""
    program, what = "pip install" if importlib.util.find_spec("pip") else "uv pip install", ""
    with suppress(importlib.metadata.PackageNotFoundError):
        what = importlib.metadata.distribution(PACKAGE).read_text("direct_url.json") or ""
    origin, extras = json.loads(what or "{}"), f"[{extra}]" if extra else ""
    if origin.get("dir_info", {}).get("editable"):
        return f"{program} -e '{unquote(urlparse(origin['url']).path)}{extras}'"
    vcs = "".join(f"{kind}+" for key, kind in origin.get("vcs_info", {}).items() if key == "vcs")
    place = f" @ {vcs}{origin['url']}" if origin else ""  # else the package index
    return f"{program} '{PACKAGE}{extras}{place}'"


@contextmanager
def needs_extra(
    extra: str,
    what: str = "a package that this needs cannot be imported",
    error: type[Pixel2CatchError] = PerceptionError,
) -> Iterator[None]:
    """Turn a failed import in this context into an error with the install command."""
    try:
        yield
    except ImportError as failed:
        raise error(f"{what} ({failed}): {install_command(extra)}.") from None


@cache
def requirements(extra: str = "") -> dict[str, SpecifierSet]:
    """Return the version ranges of required packages, or of an extra, by name; empty if not installed."""
    try:
        parsed = map(Requirement, importlib.metadata.requires(PACKAGE) or [])
    except importlib.metadata.PackageNotFoundError:
        return {}
    return {
        each.name: each.specifier
        for each in parsed
        if ("extra" in str(each.marker)) == bool(extra)
        and (each.marker is None or each.marker.evaluate({"extra": extra}))
    }


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
    """Run a probe, which returns what it found or raises an error with problem and fix; return the result."""
    try:
        state, found = "good", probe()
    except Absent as error:
        state, found = "absent", str(error)
    except (Broken, Pixel2CatchError) as error:
        state, found = "BAD", str(error)
    except Exception as error:  # a broken installation can raise anything
        state, found = "BAD", f"{type(error).__name__}: {error}: install anew, {install_command()} --upgrade"
    return Check(name=name, state=state, found=found, is_needed=is_needed)
