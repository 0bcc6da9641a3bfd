"""How this package was installed, and so the command that installs what is missing."""

import importlib.metadata
import importlib.util
import json
import shlex
from pathlib import Path
from urllib.parse import unquote, urlparse

PACKAGE = "pixel2catch"


def install_command(extra: str = "") -> str:
    """The command that installs this package once more, with an extra: from where it came.

    That is a folder with its source, a wheel, a repository, or else the index of packages.
    """
    program = "pip install" if importlib.util.find_spec("pip") else "uv pip install"
    return f"{program} {requirement(_origin(), extra)}"


def requirement(origin: dict, extra: str) -> str:
    """What to install, of an origin as PEP 610 has it (empty: the index), quoted for a shell."""
    extras = f"[{extra}]" if extra else ""
    url = origin.get("url", "")
    if "dir_info" in origin:
        option = "-e " if origin["dir_info"].get("editable") else ""
        return f"{option}{shlex.quote(unquote(urlparse(url).path) + extras)}"
    if "vcs_info" in origin:
        url = f"{origin['vcs_info']['vcs']}+{url}"
    return shlex.quote(f"{PACKAGE}{extras}{f' @ {url}' if url else ''}")


def _origin() -> dict:
    """What the installer wrote down; the folder around this file where none was at work."""
    try:
        installed = importlib.metadata.distribution(PACKAGE)
        text, installer = (installed.read_text(name) for name in ("direct_url.json", "INSTALLER"))
    except importlib.metadata.PackageNotFoundError:
        text = installer = None
    if text is None and installer is None:
        return {"url": Path(__file__).parents[2].as_uri(), "dir_info": {"editable": True}}
    return json.loads(text) if text else {}
