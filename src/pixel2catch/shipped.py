"""The policies that the package ships, and what may stand where a policy is named; loads no network."""

from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, final

from pixel2catch.checks import Requirement
from pixel2catch.errors import PolicyMismatchError, UnknownNameError

DEFAULT_POLICY = "catch_alone+fit"  #: The shipped policy that commands take where none is named.


def shipped_policies() -> dict[str, Path]:
    """Folders of the policies that the package ships, by name.

    Raises:
        PolicyMismatchError: If this installation has none.
    """
    folder = Path(str(resources.files("pixel2catch"))) / "policies"
    found = {file.parent.name: file.parent for file in sorted(folder.glob("*/policy.json"))}
    if DEFAULT_POLICY not in found:
        raise PolicyMismatchError(
            "this installation ships no policy; train one with 'pixel2catch train' and name its folder: "
            "runs/NAME/policy."
        )
    return found


def policy_folder(folder: Path | None) -> Path:
    """The own folder of a policy: of one that is shipped, of a run, or the folder itself; or its ONNX file.

    Raises:
        PolicyMismatchError: If there is none.
        UnknownNameError: If it is neither a folder nor a name.
    """
    if folder is None or not folder.exists():
        shipped = shipped_policies()
        name = str(folder or DEFAULT_POLICY)
        if name not in shipped:
            raise UnknownNameError("policy", name, shipped, "or a folder with a policy or a training run")
        folder = shipped[name]
    if folder.suffix == ".onnx" and folder.is_file():
        return folder
    if not folder.is_dir():
        raise PolicyMismatchError(
            f"'{folder}' is a file; name the folder of a policy, such as runs/NAME, or a shipped policy."
        )
    found = folder / "policy" if (folder / "policy").is_dir() else folder
    if not (found / "policy.json").is_file():
        raise PolicyMismatchError(
            f"'{folder}' holds no policy: there is no {found / 'policy.json'}; a training writes policy.json "
            "and policy.safetensors with its first checkpoint."
        )
    return found


@final
@dataclass(frozen=True)
class ExistingPolicy(Requirement):
    """A policy that is there."""

    def require(self, name: str, value: Any) -> None:  # noqa: D102 (documented in the interface)
        policy_folder(Path(value))


PolicyPath = Annotated[Path, ExistingPolicy()]
"""Folder of a policy or of its training run, its ONNX file, or the name of a shipped one."""
