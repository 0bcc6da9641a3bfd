"""Install commands for missing packages, by the way in which this package was installed."""

import importlib.metadata
import importlib.util
import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlparse

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from pixel2catch.errors import PerceptionError, Pixel2CatchError

PACKAGE = "pixel2catch"


def install_command(extra: str = "") -> str:
    """Return the command that installs this package with an extra from its origin.

    The origin is a folder, a wheel, a repository or the package index.
    """
    program = "pip install" if importlib.util.find_spec("pip") else "uv pip install"
    return f"{program} {requirement(_origin(), extra)}"


@contextmanager
def needs_extra(
    extra: str,
    what: str = "a package that this needs cannot be imported",
    error: type[Pixel2CatchError] = PerceptionError,
) -> Iterator[None]:
    """Turn a failed import in this context into an error with the install command.

    Raises:
        error: An import failed.
    """
    try:
        yield
    except ImportError as failed:
        raise error(f"{what} ({failed}): {install_command(extra)}.") from None


@cache
def requirements(extra: str = "") -> dict[str, SpecifierSet]:
    """Return the version ranges of required packages, or of an extra, by name.

    The result is empty if the package is not installed.
    """
    try:
        lines = importlib.metadata.requires(PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        lines = []
    parsed = [Requirement(line) for line in lines]
    return {
        each.name: each.specifier
        for each in parsed
        if ("extra" in str(each.marker)) == bool(extra)
        and (each.marker is None or each.marker.evaluate({"extra": extra}))
    }


def requirement(origin: dict, extra: str) -> str:
    """Return the requirement for an origin in PEP 610 form (empty: the index), quoted for a shell."""
    extras = f"[{extra}]" if extra else ""
    url = origin.get("url", "")
    if "dir_info" in origin:
        option = "-e " if origin["dir_info"].get("editable") else ""
        return f"{option}{shlex.quote(unquote(urlparse(url).path) + extras)}"
    if "vcs_info" in origin:
        url = f"{origin['vcs_info']['vcs']}+{url}"
    return shlex.quote(f"{PACKAGE}{extras}{f' @ {url}' if url else ''}")


def _origin() -> dict:
    """Return the origin recorded by the installer; without a record, the folder of this source."""
    try:
        installed = importlib.metadata.distribution(PACKAGE)
        text, installer = (installed.read_text(name) for name in ("direct_url.json", "INSTALLER"))
    except importlib.metadata.PackageNotFoundError:
        text = installer = None
    if text is None and installer is None:
        return {"url": Path(__file__).parents[2].as_uri(), "dir_info": {"editable": True}}
    return json.loads(text) if text else {}
