"""A policy as an ONNX file does what the policy does, and is refused where it does not fit."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

from pixel2catch.cli.main import main
from pixel2catch.deployment.policy_pipeline import PolicyController
from pixel2catch.errors import PolicyMismatchError, UnknownNameError
from pixel2catch.evaluation.loading import fingerprint, load_policy, sha256, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, run_round
from pixel2catch.evaluation.stress.measuring import _entry
from pixel2catch.mdp.snapshot import BoxHistory
from pixel2catch.methods import METHODS
from pixel2catch.policy import Policy, contract_of
from pixel2catch.policy.onnx_policy import OnnxPolicy, load, to_onnx
from pixel2catch.scene.objects import SEEN
from pixel2catch.shipped import shipped_policies
from pixel2catch.workcells import find_workcell

CONTRACT = contract_of(METHODS["proposed"])


def random_policy(recurrent: int) -> Policy:
    torch.manual_seed(0)
    policy = Policy(CONTRACT, hidden=(32, 16), recurrent=recurrent)
    for name in CONTRACT.agents:
        policy.network(name).input_mean.normal_()
        policy.network(name).input_std.uniform_(0.5, 2.0)
    return policy


def observations(policy: Policy, num_envs: int, scale: float = 3.0) -> dict[str, Tensor]:
    return {
        name: scale * torch.randn(num_envs, agent.num_inputs)
        for name, agent in policy.contract.agents.items()
    }


def difference(policy: Policy, other: OnnxPolicy, inputs: dict[str, Tensor]) -> float:
    actions, others = policy.act(inputs), other.act(inputs)
    assert list(actions) == list(others)
    return max(float((actions[name] - others[name]).abs().max()) for name in actions)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default policy, by the command."""
    file = tmp_path_factory.mktemp("onnx") / "made" / "catch.onnx"
    assert main(["export", "--out", str(file)]) == 0
    return file


def test_action_by_hand() -> None:
    """One input 7 with mean 3 and deviation 2 is 2; ELU(0.5 * 2 - 3) = e^-2 - 1; times -0.5 plus 0.25."""
    agent = dataclasses.replace(CONTRACT.agents["arm"], observation=(("x", 1),), joints=("elbow_joint",))
    policy = Policy(dataclasses.replace(CONTRACT, agents={"arm": agent}), hidden=(1,))
    network = policy.network("arm")
    network.input_mean.fill_(3.0)
    network.input_std.fill_(2.0)
    for parameter, value in zip(network.parameters(), (0.5, -3.0, -0.5, 0.25), strict=True):
        torch.nn.init.constant_(parameter, value)
    exported = OnnxPolicy(to_onnx(policy))
    act = exported.act({"arm": torch.tensor([[7.0], [1e9], [-1e9]])})["arm"][:, 0]
    elu = torch.tensor([-2.0, 0.5 * 5 - 3, 0.5 * -5 - 3]).exp() - 1
    torch.testing.assert_close(act, 0.25 - 0.5 * elu)
    torch.nn.init.constant_(list(network.parameters())[-1], 10.0)
    assert OnnxPolicy(to_onnx(policy)).act({"arm": torch.zeros(2, 1)})["arm"].tolist() == [[1.0], [1.0]]


@pytest.mark.parametrize("name", ["catch+fit", "proposed", "single_agent-seed0"])
def test_shipped_policies_on_ten_thousand_inputs(name: str) -> None:
    policy = Policy.load(shipped_policies()[name])
    torch.manual_seed(1)
    assert difference(policy, OnnxPolicy(to_onnx(policy)), observations(policy, 10_000)) < 1e-5


def test_a_recurrent_policy_on_ten_thousand_inputs_and_resets() -> None:
    """A hundred steps of a hundred episodes, which end at random; and it does remember."""
    policy = random_policy(recurrent=24)
    exported = OnnxPolicy(to_onnx(policy))
    first = observations(policy, 100)
    afresh = exported.act(first)["arm"]
    assert (exported.act(first)["arm"] - afresh).abs().max() > 1e-3
    exported.reset()
    for _ in range(100):
        assert difference(policy, exported, observations(policy, 100)) < 1e-5
        is_ended = torch.rand(100) < 0.02
        policy.reset(is_ended)
        exported.reset(is_ended)
    exported.reset()
    assert torch.equal(exported.act(first)["arm"], afresh)


class Compared:
    """Acts as the first policy, and asks the others what they would have done."""

    def __init__(self, policy: Policy, pairs: list[tuple[Policy, OnnxPolicy]]) -> None:
        self._policy, self._pairs = policy, pairs
        self.differences, self.num_episodes = list[float](), 0

    def reset(self, is_ended: Tensor | None = None) -> None:
        for actor in (self._policy, *(actor for pair in self._pairs for actor in pair)):
            actor.reset(is_ended)

    def act(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        self.num_episodes = max(map(len, observations.values()))
        self.differences += [difference(*pair, observations) for pair in self._pairs]
        return self._policy.act(observations)


@pytest.mark.slow
def test_a_hundred_episodes(file: Path) -> None:
    """The default policy in its throws, and one with a GRU beside it."""
    policy, method = load_policy(None)
    assert isinstance(policy, Policy)
    recurrent = Policy(policy.contract, hidden=(16,), recurrent=8)
    pairs = [(policy, OnnxPolicy(file)), (recurrent, OnnxPolicy(to_onnx(recurrent)))]
    compared = Compared(policy, pairs)
    task = task_of(policy, physics_hz=120.0)
    cfg = EvaluationCfg(objects=SEEN, num_envs=100, trials=1, task=task)
    env = cfg.make_env(method)
    try:
        caught = run_round(env, compared).record.is_success
    finally:
        env.close()
    assert compared.num_episodes == 100
    assert caught.sum() > 80
    assert len(compared.differences) > 100
    assert max(compared.differences) < 1e-5


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


def test_the_file_alone_is_enough_where_there_is_no_torch(file: Path) -> None:
    """With nothing but ONNX Runtime and NumPy: sizes of inputs are in the contract."""
    done = subprocess.run([sys.executable, "-c", RUN, str(file)], capture_output=True, text=True, check=True)
    policy, _ = load_policy(None)
    blank = {name: torch.zeros(1, agent.num_inputs) for name, agent in policy.contract.agents.items()}
    for name, action in policy.act(blank).items():
        np.testing.assert_allclose(json.loads(done.stdout)[name], action.numpy(), atol=1e-5)


def test_the_file_is_taken_wherever_a_policy_is(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy, method = load_policy(file)
    original, _ = load_policy(None)
    assert isinstance(policy, OnnxPolicy)
    assert (policy.contract, method.name) == (original.contract, original.contract.method)
    assert fingerprint(file) == sha256(file)
    assert _entry(file).name == "catch"
    args = ["evaluate", str(file), "--num-envs", "1", "--trials", "1", "--physics-hz", "120", "--json"]
    assert main(args) == 0
    assert json.loads(capsys.readouterr().out)["policy_sha256"] == sha256(file)


def test_a_robot_gets_the_same_targets(file: Path) -> None:
    """What `deploy`, `rehearse` and `replay` decide with; an object comes nearer, the robot rests."""
    workcell = find_workcell(CONTRACT.workcell)
    controllers = [PolicyController(load_policy(path)[0], workcell) for path in (file, None)]
    joint_pos, num_boxes = torch.zeros(1, len(workcell.joints)), controllers[0].method.num_boxes
    boxes = BoxHistory.begun(torch.tensor([[300.0, 100.0, 310.0, 110.0]]), torch.tensor([1.5]), num_boxes)
    targets = []
    for step in range(20):
        box = boxes.box[:, 0] + torch.tensor([-1.0, 3.0, 0.0, 5.0])
        boxes = boxes.advanced(box, torch.tensor([1.5]), torch.tensor([step % 7 > 0]))
        found, expected = (controller.step(joint_pos, boxes) for controller in controllers)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0.0)
        targets.append(found)
    assert (targets[-1] - targets[0]).abs().max() > 0.01


@pytest.mark.slow
def test_a_rehearsal_with_the_file(file: Path, tmp_path: Path) -> None:
    args = ["--lockstep", "--plain", "--throws", "1", "--seed", "3", "--out", str(tmp_path / "report")]
    assert main(["rehearse", str(file), *args]) == 0
    report = json.loads((tmp_path / "report/report.json").read_text())
    assert (report["success_rate"], report["problems"]) == (1.0, 0)


def altered(file: Path, out: Path, **description: object) -> Path:
    """The file, with another contract."""
    model = onnx.load(file)
    text = json.loads(model.metadata_props[0].value) | description
    onnx.helper.set_model_props(model, {"policy": json.dumps(text)})
    onnx.save(model, out)
    return out


def test_another_contract_is_refused_by_its_field(file: Path, tmp_path: Path) -> None:
    agents = json.loads(json.dumps(dataclasses.asdict(CONTRACT)))["agents"]
    for change, message in (
        ({"format_version": 99}, "'format_version' is 99, this code reads 2"),
        ({"colour": "red"}, "unknown field 'colour'"),
        ({"recurrent": 7}, r"'hidden_state\.\w+' has size None, and 7 by its contract"),
        ({"agents": agents}, r"'observation\.\w+' has size"),
    ):
        with pytest.raises(PolicyMismatchError, match=message):
            load(altered(file, tmp_path / "altered.onnx", **change))
    with pytest.raises(PolicyMismatchError, match="control_dt"):
        load_policy(altered(file, tmp_path / "altered.onnx", control_dt=0.02))


def test_damaged_foreign_and_missing_files(file: Path, tmp_path: Path) -> None:
    damaged, foreign = tmp_path / "damaged.onnx", tmp_path / "foreign.onnx"
    for content in (b"", b"no model", file.read_bytes()[:1000]):
        damaged.write_bytes(content)
        with pytest.raises(PolicyMismatchError, match="is damaged, or no ONNX file"):
            load(damaged)
    model = onnx.load(file)
    model.ClearField("metadata_props")
    onnx.save(model, foreign)
    with pytest.raises(PolicyMismatchError, match=r"an ONNX file, but no policy\. Make one with"):
        load(foreign)
    with pytest.raises(UnknownNameError, match=r"missing\.onnx"):
        load_policy(tmp_path / "missing.onnx")
    with pytest.raises(PolicyMismatchError, match=r"cannot read the policy '.*damaged\.onnx'"):
        Policy.load(damaged)


def test_a_policy_with_weights_that_are_no_numbers_is_not_exported() -> None:
    policy = random_policy(recurrent=0)
    torch.nn.init.constant_(next(policy.network("hand").parameters()), torch.nan)
    with pytest.raises(PolicyMismatchError, match=r"weights 'weight\d+' are .* not finite"):
        to_onnx(policy)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--out", "policy.bin"], "must end in .onnx"),
        (["{file}", "--out", "again.onnx"], "is an ONNX file already"),
        (["--out", "{file}"], "exists; choose another name"),
        (["nobody"], "nobody"),
    ],
)
def test_mistakes(args: list[str], message: str, file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", *(arg.format(file=file) for arg in args)]) == 2
    assert message in capsys.readouterr().err
    assert not Path("again.onnx").exists()
