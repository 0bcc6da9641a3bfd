"""Shipped policies, and the resolution of policy names and folders; loads no network."""

from importlib import resources
from pathlib import Path
from typing import Annotated

from pixel2catch.checks import Meets
from pixel2catch.errors import PolicyMismatchError, UnknownNameError

DEFAULT_POLICY = "catch_alone+fit"  #: Default policy of all commands.

COMPUTED = ("analytic", "analytic_told")
"""Names of policies that no folder has; NAME@WORKCELL is one for another work cell than the paper's."""


def is_computed(path: Path) -> bool:
    """Return whether a path is the name of a computed policy."""
    return str(path).partition("@")[0] in COMPUTED and not path.exists()


def shipped_policies() -> dict[str, Path]:
    """Return the folders of the shipped policies, by name."""
    folder = Path(str(resources.files("pixel2catch"))) / "policies"
    found = {file.parent.name: file.parent for file in sorted(folder.glob("*/policy.json"))}
    if DEFAULT_POLICY not in found:
        raise PolicyMismatchError("no policy is installed; train one and give its folder, runs/NAME.")
    return found


def policy_folder(folder: Path | None) -> Path:
    """Return the folder of a policy, for its folder, its run or a shipped name (default: `DEFAULT_POLICY`).

    ONNX files and names of computed policies are returned as they are. Raises PolicyMismatchError for a
    folder without a policy, UnknownNameError for another name.
    """
    if folder is not None and is_computed(folder):
        return folder
    if folder is None or not folder.exists():
        shipped = shipped_policies()
        name = str(folder or DEFAULT_POLICY)
        if name not in shipped:
            raise UnknownNameError("policy", name, [*shipped, *COMPUTED, "or a folder of a policy or a run"])
        folder = shipped[name]
    if folder.suffix == ".onnx" and folder.is_file():
        return folder
    if not folder.is_dir():
        raise PolicyMismatchError(f"'{folder}' is a file; give a policy's folder, as runs/NAME, or a name.")
    found = folder / "policy" if (folder / "policy").is_dir() else folder
    if not (file := found / "policy.json").is_file():
        raise PolicyMismatchError(f"'{folder}' has no policy; a training writes '{file}' with a checkpoint.")
    return found


PolicyPath = Annotated[Path, Meets(policy_folder, "name a policy")]
"""Folder of a policy or of its training run, its ONNX file, or the name of a shipped one."""
