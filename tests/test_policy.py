"""The policy file and its contract."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pixel2catch.errors import PolicyMismatchError
from pixel2catch.methods import METHODS, find_method
from pixel2catch.policy import Policy, PolicyContract, contract_of, method_of
from pixel2catch.workcells import find_workcell

METHOD = METHODS["proposed"]
RIGHT = find_workcell("ur5e_allegro_right")
CONTRACT = contract_of(METHOD)


@pytest.fixture
def policy() -> Policy:
    torch.manual_seed(0)
    policy = Policy(CONTRACT, hidden=(8, 8))
    for name in CONTRACT.agents:
        policy.network(name).input_mean.normal_()
        policy.network(name).input_std.uniform_(0.5, 2.0)
    return policy


def observations(scale: float = 1.0) -> dict[str, torch.Tensor]:
    return {name: scale * torch.randn(5, agent.num_inputs) for name, agent in CONTRACT.agents.items()}


def test_save_and_load(policy: Policy, tmp_path: Path) -> None:
    policy.save(tmp_path / "run/policy")
    loaded = Policy.load(tmp_path / "run/policy")
    assert loaded.contract == CONTRACT
    inputs = observations()
    expected, actions = policy.act(inputs), loaded.act(inputs)
    assert all(torch.equal(expected[name], actions[name]) for name in ("arm", "hand"))
    files = {path.name for path in (tmp_path / "run/policy").iterdir()}
    assert files == {"policy.safetensors", "policy.json"}


def test_a_mismatch_names_the_fields() -> None:
    """A policy of another task fits: it may act wherever its other fields fit."""
    wide = replace(CONTRACT, task="wide")
    wide.require(CONTRACT)
    CONTRACT.require(wide)
    assert PolicyContract.from_dict(json.loads(json.dumps(wide.to_dict()))).task == "wide"
    other = replace(contract_of(METHODS["only_wh"], RIGHT), control_dt=0.02)
    with pytest.raises(PolicyMismatchError) as error:
        wide.require(other)
    for words in (
        "method: policy 'proposed', here 'only_wh'",
        "control_dt: policy 0.0333",
        "workcell: policy 'ur5e_allegro', here 'ur5e_allegro_right'",
        "agents.arm.observation",
    ):
        assert words in str(error.value)
    for word in ("camera", "task"):
        assert word not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 99}, "format_version is 99, this code reads 2"),
        ({"camera": None}, "field 'camera': it is missing"),
        ({"colour": "red"}, "unknown field 'colour'"),
        ({"object_radius": 0.0}, "object_radius is 0; it must be greater than 0"),
        ({"hidden": None}, "field 'hidden' is missing"),
        ({"hidden": [8, 9]}, r"agents.arm.network.2.weight: .* torch.Size\(\[9, 8\]\)"),
    ],
)
def test_a_bad_file_names_the_field(
    change: dict[str, object], message: str, policy: Policy, tmp_path: Path
) -> None:
    policy.save(tmp_path)
    text = json.loads((tmp_path / "policy.json").read_text()) | change
    text = {name: value for name, value in text.items() if value is not None}
    rewrite(tmp_path, json.dumps(text))
    with pytest.raises(PolicyMismatchError, match=message):
        Policy.load(tmp_path)


def test_damage(policy: Policy, tmp_path: Path) -> None:
    with pytest.raises(PolicyMismatchError, match=r"No such file .*policy\.json"):
        Policy.load(tmp_path)
    policy.save(tmp_path)
    weights = (tmp_path / "policy.safetensors").read_bytes()
    (tmp_path / "policy.json").write_text("{}")
    with pytest.raises(PolicyMismatchError, match="not of the same save"):
        Policy.load(tmp_path)
    policy.network("arm").input_std[0] = 0.0
    policy.save(tmp_path)
    with pytest.raises(PolicyMismatchError, match="input_std' must have standard deviations greater than 0"):
        Policy.load(tmp_path)
    (tmp_path / "policy.safetensors").write_bytes(weights[:-100])
    with pytest.raises(PolicyMismatchError, match="is damaged"):
        Policy.load(tmp_path)


def rewrite(folder: Path, text: str) -> None:
    """Change the contract in both files, as a consistent save of another version would have."""
    from safetensors.torch import load_file, save_file

    tensors = load_file(folder / "policy.safetensors")
    save_file(tensors, folder / "policy.safetensors", metadata={"policy": text})
    (folder / "policy.json").write_text(text)


@pytest.mark.parametrize("term", ["fit_boxes", "ObservationInputs"])
def test_an_unknown_method_whose_term_is_another_function_does_not_fit(term: str) -> None:
    contract = contract_of(replace(find_method("proposed"), name="mine"))
    arm = contract.agents["arm"]
    terms = tuple((name.replace("palm_pose", term), size) for name, size in arm.observation)
    agents = contract.agents | {"arm": replace(arm, observation=terms)}
    with pytest.raises(PolicyMismatchError, match="observes or remembers"):
        method_of(replace(contract, agents=agents))
