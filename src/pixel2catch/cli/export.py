"""`pixel2catch export`: a policy as an ONNX file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from pixel2catch.checks import OutputFile
from pixel2catch.cli.console import prepare, suggest
from pixel2catch.files import write_atomically
from pixel2catch.shipped import DEFAULT_POLICY, PolicyPath


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a policy as one ONNX file.

    It has networks, input statistics and the whole contract. Other commands take it in the place of a
    policy's folder.
    """

    #: Folder of a policy or of its training run, or a shipped name. Default: catch_alone+fit.
    policy: Positional[PolicyPath | None] = None
    #: The new file. Default: the policy's name in the working directory.
    out: Annotated[Path, OutputFile((".onnx",))] | None = None

    def run(self) -> None:
        from pixel2catch.evaluation.loading import load_policy
        from pixel2catch.policy.onnx_policy import SUFFIX, largest_difference, to_onnx

        source = self.policy or Path(DEFAULT_POLICY)
        name = source.resolve().parent.name if source.name == "policy" else source.stem
        out = self.out or Path(f"{name}{SUFFIX}")
        prepare("cpu")
        policy, _ = load_policy(self.policy)
        OutputFile(is_new=True).require("out", out)
        data = to_onnx(policy)
        write_atomically({out: data})
        difference = largest_difference(policy, data)
        print(
            f"wrote {out}: {policy.contract.method}, {len(data) / 1e6:.1f} MB; actions differ from the "
            f"original's by {difference:.1e} at most, on 10,000 random inputs"
        )
        suggest("evaluate", out)
