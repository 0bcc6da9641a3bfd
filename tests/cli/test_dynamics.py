"""`--dynamics FILE` of train, evaluate and play, with the real commands."""

import json
from pathlib import Path

import pytest
import torch

from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.evaluation.loading import task_of
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.methods import METHODS
from pixel2catch.policy import Policy, contract_of
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.scene import SceneCfg

SIZE = ("--num-envs", "4", "--rollout-steps", "4", "--transitions", "32", "--hidden", "8")
TRAIN = ("train", "only_center", "--device", "cpu", *SIZE, "--env.scene.physics-hz", "30")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of an arm alone, that has latency and filters."""
    path = tmp_path_factory.mktemp("identified") / "arm.json"
    arm = JointDynamics.nominal(JointDynamics.nominal().joints[:6])
    arm = arm.with_values(latency=0.02, filter_gain=300.0, filter_lookahead=0.1)
    DynamicsFile(dynamics=arm, gains=GainRanges(stiffness_scale=((0.99, 1.01),) * 19)).save(path)
    return path


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("untrained")
    Policy(contract_of(METHODS["proposed"]), hidden=(8,)).save(folder)
    return folder


def run(*args: str | Path) -> int:
    return main([str(arg) for arg in args])


def test_training_simulates_the_robot_of_the_file(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "run"
    assert run(*TRAIN, "--out", out, "--dynamics", file, "--env.sensing.latency-steps", "1", "3") == 0
    assert (out / "dynamics.json").read_bytes() == file.read_bytes()
    task = json.loads((out / "config.json").read_text())["env"]
    assert task["dynamics"]["latency"] == [0.02] * 6
    assert task["sensing"]["latency_steps"] == [1, 3]
    assert task["randomization"]["gains"]["stiffness_scale"] == [[0.99, 1.01]] * 6 + [[0.7, 1.3]] * 13
    other = tmp_path / "other.json"
    DynamicsFile().save(other)
    assert run(*TRAIN, "--out", out, "--resume", "--dynamics", other) == 2
    assert "leave out --dynamics" in capsys.readouterr().err
    assert run(*TRAIN, "--out", out, "--resume") == 0
    assert json.loads((out / "config.json").read_text())["env"] == task


def test_task_of_a_policy_has_the_robot_of_the_file(file: Path, untrained: Path):
    policy, content = Policy.load(untrained), DynamicsFile.load(file)
    task = task_of(policy, 30.0, file)
    assert task == CatchEnvCfg(
        scene=SceneCfg(physics_hz=30.0),
        dynamics=content.dynamics,
        randomization=RandomizationCfg(gains=content.gains),
    )
    assert task_of(policy, 30.0) == CatchEnvCfg(scene=SceneCfg(physics_hz=30.0))


@pytest.mark.parametrize("command", [TRAIN, ("evaluate",), ("play",)], ids=lambda command: command[0])
def test_a_bad_file_is_refused_before_anything_is_written(
    command: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bad = tmp_path / "bad.json"
    bad.write_text('{"format_version": 1, "joints": ["elbow"]}')
    out = ("--out", tmp_path / "out.mp4")
    for path, reason in ((bad, "is missing"), (tmp_path / "none.json", "which is not there")):
        assert run(*command, "--dynamics", path, *out) == 2
        error = capsys.readouterr().err
        assert f"'{path}'" in error
        assert reason in error
    assert [path.name for path in tmp_path.iterdir()] == ["bad.json"]
