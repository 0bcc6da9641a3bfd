"""`--env.FIELD` of the commands that evaluate, and the log of a training for others."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from pixel2catch.cli.fields import with_given
from pixel2catch.cli.main import main, parse
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.errors import UnknownNameError
from pixel2catch.installation import install_command
from pixel2catch.methods import METHODS, find_method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.scene.cfg import SceneCfg

THROWS = ("--objects", "cube_s", "--num-envs", "2", "--trials", "1", "--env.scene.physics-hz", "60")
TRAINING = ("--num-envs", "4", "--rollout-steps", "2", "--mini-batches", "2", "--transitions", "16")
TRAIN = ("train", *TRAINING, "--hidden", "8", "--device", "cpu", "--env.scene.physics-hz", "30")


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fields") / "policy"
    Policy(contract_of(METHODS["proposed"]), hidden=(8,)).save(folder)
    return folder


def test_only_given_fields_change_a_task():
    """A given value counts even where it is the default of the paper's task."""
    wide = replace(find_task("wide"), scene=SceneCfg(physics_hz=600.0))
    given = CatchEnvCfg(objects=("cube_s",))
    changed = with_given(wide, given, ("scene.physics_hz", "objects"))
    assert changed == replace(wide, scene=SceneCfg(physics_hz=120.0), objects=("cube_s",))


def test_a_field_reaches_an_evaluation(policy: Path, capsys: pytest.CaptureFixture[str]):
    """An object that flies far away from the robot is never tracked."""
    far = ("--env.throws.release-x=6", "6.1", "--env.throws.aim-x", "5", "5.1")
    assert main(["evaluate", str(policy), *THROWS, "--json", *far]) == 0
    assert json.loads(capsys.readouterr().out)["tracking_rate"] == 0.0


def test_a_field_holds_beneath_every_disturbance(policy: Path, tmp_path: Path):
    out = tmp_path / "stress"
    command = ["stress", str(policy), *THROWS, "--axes", "air", "--out", str(out)]
    assert main([*command, "--env.sensing.drop-rate", "0.1", "0.2"]) == 0
    for file in (out / "cells").rglob("*.json"):
        task = json.loads(file.read_text())["evaluation"]["task"]
        assert task["sensing"]["drop_rate"] == [0.1, 0.2]
        assert task["randomization"]["air_density"] == 1.2
    assert main(command) == 2  # the results that are there are of another task


@pytest.mark.parametrize("command", ["evaluate", "play", "stress"])
def test_what_the_protocol_sets_is_refused(
    command: str, policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], opengl: None
):
    assert main([command, str(policy), "--out", str(tmp_path / "out.mp4"), "--env.objects", "cross"]) == 2
    assert "--env.objects" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["evaluate", "play", "stress", "bench"])
def test_a_misspelt_field_is_named(command: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        parse([command, "--env.throws.peak", "1", "2"])
    assert "throws.peak-z" in capsys.readouterr().err


def test_weights_reach_teammates_and_unknown_terms_are_refused():
    changed = find_method("shared_reward").with_weights({"hand.success": 3.0})
    weights = [agent.to_dict()["rewards"]["hand.success"] for agent in changed.agents]
    assert weights == [3.0, 3.0]
    with pytest.raises(UnknownNameError, match=r"unknown reward term 'hand\.grip'.*hand\.success"):
        find_method("proposed").with_weights({"hand.grip": 3.0})


def test_weights_and_biases_gets_configuration_and_curves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Offline, as without an account; a training that goes on goes on with its run."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    out = tmp_path / "run"
    assert main([*TRAIN, "--wandb", "catching", "--out", str(out)]) == 0
    number = (out / "wandb.id").read_text()
    (folder,) = (out / "wandb").glob("offline-run-*")
    written = (folder / f"run-{number}.wandb").read_bytes()
    assert b"reward_term/arm.success" in written
    assert b"initial_log_std" in written


def test_a_missing_package_is_named_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert main([*TRAIN, "--wandb", "catching", "--out", str(tmp_path / "run")]) == 2
    assert install_command("wandb") in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
