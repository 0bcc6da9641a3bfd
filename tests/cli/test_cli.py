"""The command line, mostly as a user starts it: in a process of its own."""

import dataclasses
import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import commands
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.cli.console import prepare
from pixel2catch.cli.fields import HIDDEN
from pixel2catch.cli.main import main, parse
from pixel2catch.cli.reproduce import METHODS
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.evaluation.protocol import EvaluationCfg, evaluate
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.experiment import preset
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.methods import PROPOSED, find_method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.shipped import DEFAULT_POLICY, shipped_policies

needs_no_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")


def pixel2catch(*args: str | Path) -> subprocess.CompletedProcess[str]:
    return commands.pixel2catch(*args, COLUMNS="100", NO_COLOR="1")


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("untrained")
    Policy(contract_of(PROPOSED), hidden=(16,)).save(folder)
    return folder


@pytest.mark.parametrize("args", [["--help"], ["train", "--help"]], ids=" ".join)
def test_help_imports_nothing_heavy(args: list[str]):
    check = f"""
import sys, pytest, pixel2catch.cli.main
with pytest.raises(SystemExit):
    pixel2catch.cli.main.main({args})
assert not {{'torch', 'mujoco', 'warp', 'scipy'}} & set(sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", check], check=False, capture_output=True).returncode == 0


def test_version(capsys: pytest.CaptureFixture[str]):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("pixel2catch 0.")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("evaluate", "--nope"), ("--nope", "help")),
        (("evaluate", "--num-envs", "many"), ("many", "--num-envs")),
    ],
)
def test_wrong_arguments_say_what_is_right(
    args: tuple[str, ...], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit, match="2"):
        main(args)
    output = capsys.readouterr()
    for word in words:
        assert word in output.out + output.err


def one_line_error(capsys: pytest.CaptureFixture[str], *args: str | Path) -> str:
    """The error of a command, after its common beginning."""
    assert main([str(arg) for arg in args]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("pixel2catch: error: ")
    return "\n".join(lines)


@needs_no_cuda
@pytest.mark.parametrize("command", ["train", "evaluate", "bench"])
def test_absent_cuda(command: str, capsys: pytest.CaptureFixture[str]):
    assert "--device cpu" in one_line_error(capsys, command, "--device", "cuda")


@pytest.mark.parametrize(("device", "index"), [("cuda", 0), ("cuda:1", 1)])
def test_a_cuda_device_is_named_in_full(device: str, index: int, monkeypatch: pytest.MonkeyPatch):
    """PyTorch takes no device without its number for the one to use."""
    used: list[int] = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", used.append)
    assert prepare(device) == f"cuda:{index}"
    assert used == [index]


@pytest.mark.parametrize("name", shipped_policies())
def test_shipped_policies_fit_this_code(name: str):
    """They are called as their method and `-seedN`, where there are several, or as another work cell."""
    policy, method = load_policy(Path(name))
    own = policy.contract.workcell
    assert (method.name if own == "ur5e_allegro" else own) == name.partition("-")[0]


def test_shipped_policies_of_every_compared_method():
    """Three seeds of the paper's method, one of each other, two for outside, their teacher, other robots."""
    compared = {name for name, method in METHODS.items() if method.value_input == "state"}
    expected = {f"{name}-seed0" for name in compared} | {"proposed", "proposed-seed1", "proposed-seed2"}
    assert set(shipped_policies()) == expected | {
        "catch+fit",
        "catch_alone+fit",
        "catch_teacher+age",
        "fr3_allegro",
        "two_ur5e_allegro",
        "ur5e_leap",
    }
    assert load_policy(None)[1] == find_method(DEFAULT_POLICY)


def test_evaluate_prints_one_json_object(untrained: Path, tmp_path: Path):
    files = {name: tmp_path / f"{name}.json" for name in ("dynamics", "camera")}
    DynamicsFile().save(files["dynamics"])
    CameraFile(camera=dataclasses.replace(RGB_CAMERA, pos=(-0.4, 0.0, 2.2)), focal_std=0.01).save(
        files["camera"]
    )
    given = [argument for name, file in files.items() for argument in (f"--{name}", file)]
    args = ("--objects", "cube_s", "cone_l", "--num-envs", "4", "--trials", "1", "--json")
    result = pixel2catch("evaluate", untrained, *args, *given)
    assert result.returncode == 0, result.stderr
    assert "trained for another camera" in result.stderr
    metrics = json.loads(result.stdout)
    assert metrics["trials"] == 4
    assert metrics["objects_thrown"] == ["cube_s", "cone_l"]
    assert set(metrics["objects"]) <= {"cube_s", "cone_l"}
    assert metrics["policy"] == str(untrained)
    for name, file in files.items():
        assert metrics[f"{name}_sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert metrics.keys() >= {"success_rate_interval", "verified_hold_rate", "failures", "max_torque_share"}


def test_bench_splits_a_training_into_its_parts(tmp_path: Path):
    out = tmp_path / "new" / "costs.json"
    task = ["--env.scene.cone", "pyramidal", "--env.scene.physics-hz", "60", "--env.episode.max-steps", "5"]
    assert main(["bench", "--num-envs", "4", "--updates", "1", *task, "--out", str(out)]) == 0
    (row,) = json.loads(out.read_text())["results"]
    assert (row["device"], row["num_envs"], row["physics_hz"]) == ("cpu", 4, 60.0)
    parts = [row[f"{part}_us"] for part in ("rollout", "update")]
    assert min(parts) > 0.0
    assert sum(parts) == pytest.approx(1e6 / row["training_steps_per_second"])
    assert row["rss_bytes"] > 1e8 > row["device_bytes"]


def test_train_has_and_explains_every_option_of_its_configuration():
    text = " ".join(pixel2catch("train", "--help").stdout.replace("│", "").split())
    assert "None" not in text
    for field in dataclasses.fields(TrainCfg):
        if field.name in HIDDEN:
            continue
        flag = f"--{field.name.replace('_', '-')}" + ("" if field.default is False else r" [A-Z{\[]\S*")
        said = re.search(rf"{flag} .*?[A-Z].*?(\(default: .*?\)|Default: .*?\.)", text)
        assert said, field.name
        if type(field.default) in (int, float, str) and field.default != "cuda":
            assert said[1].startswith(f"(default: {field.default}"), field.name


def test_what_is_not_given_to_train_is_of_the_preset():
    args = ["train", "--device", "cpu", "--preset", "paper", "--seed", "4"]
    command = parse(args)
    expected = preset("paper", device="cpu", seed=4)
    assert (command.train, command.env) == (expected.train, expected.env)
    command, expected = parse(["train", "--device", "cpu"]), preset("cpu")
    assert (command.train, command.env) == (expected.train, expected.env)


def test_evaluations_of_a_recurrent_policy_repeat(tmp_path: Path):
    out = tmp_path / "run"
    size = ("--num-envs", "4", "--rollout-steps", "4", "--transitions", "16", "--hidden", "16")
    options = ("--device", "cpu", *size, "--recurrent", "8", "--out", str(out))
    assert main(["train", "proposed", *options]) == 0
    policy, _ = load_policy(out)
    assert policy.recurrent == 8
    cfg = EvaluationCfg(objects=("cube_s",), num_envs=3, trials=1)
    records = [evaluate(policy, PROPOSED, cfg).record for _ in range(2)]
    for first, second in zip(*(vars(record).values() for record in records), strict=True):
        assert torch.equal(first, second)
