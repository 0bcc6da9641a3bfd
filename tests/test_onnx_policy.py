"""A policy as an ONNX file acts as the policy does, and is refused where it does not fit."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from pixel2catch.cli.main import main
from pixel2catch.errors import NonFiniteError, PolicyMismatchError, UnknownNameError
from pixel2catch.evaluation.loading import fingerprint, load_policy, sha256
from pixel2catch.policy import Policy
from pixel2catch.policy.onnx_policy import largest_difference, load, to_onnx
from pixel2catch.shipped import DEFAULT_POLICY, shipped_policies
from test_policy import policy

__all__ = ["policy"]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default policy, by the command."""
    file = tmp_path_factory.mktemp("onnx") / "made" / "catch.onnx"
    assert main(["export", "--out", str(file)]) == 0
    return file


def test_onnx_runtime_computes_the_actions_of_the_default_policy(file: Path) -> None:
    assert largest_difference(Policy.load(shipped_policies()[DEFAULT_POLICY]), file.read_bytes()) < 1e-5


def test_a_file_has_the_weights_of_its_policy(policy: Policy, tmp_path: Path) -> None:
    (tmp_path / "mine.onnx").write_bytes(to_onnx(policy))
    loaded = load(tmp_path / "mine.onnx")
    assert (loaded.contract, loaded.hidden) == (policy.contract, (8, 8))
    for name, value in policy.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name


RUN = """
import sys
sys.modules["torch"] = None
import json, numpy, onnxruntime
session = onnxruntime.InferenceSession(sys.argv[1])
contract = json.loads(session.get_modelmeta().custom_metadata_map["policy"])
sizes = {name: sum(size for _, size in agent["observation"]) for name, agent in contract["agents"].items()}
inputs = {f"observation.{name}": numpy.zeros((1, size), numpy.float32) for name, size in sizes.items()}
print(json.dumps({name: session.run([f"action.{name}"], inputs)[0].tolist() for name in sizes}))
"""


def test_the_file_is_enough_without_torch_and_names_no_path_of_this_machine(file: Path) -> None:
    done = subprocess.run([sys.executable, "-c", RUN, str(file)], capture_output=True, text=True, check=True)
    policy, _ = load_policy(None)
    blank = {name: torch.zeros(1, agent.num_inputs) for name, agent in policy.contract.agents.items()}
    for name, action in policy.act(blank).items():
        np.testing.assert_allclose(json.loads(done.stdout)[name], action.numpy(), atol=1e-5)
    assert str(Path(__file__).parents[1]).encode() not in file.read_bytes()


def test_the_file_is_taken_in_place_of_a_folder(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy, method = load_policy(file)
    assert (policy.contract, method.name) == (load_policy(None)[0].contract, policy.contract.method)
    assert fingerprint(file) == sha256(file)
    rounds = ("--num-envs", "1", "--trials", "1", "--env.scene.physics-hz", "120")
    assert main(["evaluate", str(file), *rounds, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["policy_sha256"] == sha256(file)


def test_damaged_foreign_and_missing_files(file: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.onnx"
    for content in (b"", file.read_bytes()[:1000]):
        bad.write_bytes(content)
        with pytest.raises(PolicyMismatchError, match="damaged"):
            load(bad)
    model = onnx.load(file)
    model.ClearField("metadata_props")
    onnx.save(model, bad)
    with pytest.raises(PolicyMismatchError, match="no policy"):
        load(bad)
    with pytest.raises(UnknownNameError, match=r"missing\.onnx"):
        load_policy(tmp_path / "missing.onnx")


def test_a_policy_with_weights_that_are_not_finite_is_not_exported(policy: Policy) -> None:
    torch.nn.init.constant_(next(policy.network("hand").parameters()), torch.nan)
    with pytest.raises(NonFiniteError, match="not finite"):
        to_onnx(policy)
