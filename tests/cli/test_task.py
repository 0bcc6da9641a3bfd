"""`--task NAME` of train: what a run is trained for, and what becomes of its policy."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from paper_robot import ARM_JOINTS, HAND_JOINTS
from pixel2catch.api.training import with_task
from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import TASKS
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.learning.config import preset
from pixel2catch.policy import Policy
from pixel2catch.scene.cfg import SceneCfg
from pixel2catch.scene.constants import OBJECT_RADIUS
from pixel2catch.shipped import policy_folder
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

SIZE = (
    "--num-envs",
    "4",
    "--rollout-steps",
    "4",
    "--transitions",
    "32",
    "--hidden",
    "8",
    "--env.scene.physics-hz",
    "30",
)
TRAIN = ("train", "catch+fit", "--preset", "cpu", "--device", "cpu", *SIZE)


def run(*args: str | Path) -> int:
    return main([str(arg) for arg in args])


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run for the world outside."""
    folder = tmp_path_factory.mktemp("wide") / "run"
    assert run(*TRAIN, "--task", "wide", "--out", folder) == 0
    return folder


def test_training_is_for_the_task(out: Path):
    """The run says which, with all of its ranges; images of nominal episodes are as late as ever."""
    policy, method = load_policy(out)
    assert (policy.contract.task, method.name) == ("wide", "catch+fit")
    assert policy.contract.object_radius == OBJECT_RADIUS
    config = json.loads((out / "config.json").read_text())
    assert config["train"]["task"] == "wide"
    assert config["env"]["value_sees_parameters"]
    assert config["env"]["sensing"]["latency_steps"] == [1, 2]
    variants = config["env"]["variants"]
    assert [variant["share"] for variant in variants] == [v.share for v in TASKS["wide"].variants]
    for found, variant in zip(variants, TASKS["wide"].variants, strict=True):
        assert found["sensing"]["latency_steps"] == list(variant.sensing.latency_steps)
        ranges = found["randomization"]["gains"]["stiffness_scale"]
        of_all = variant.randomization.gains.of(UR5E_ALLEGRO).stiffness_scale
        assert ranges == [list(limits) for limits in of_all]
        assert len(ranges) == len(ARM_JOINTS) + len(HAND_JOINTS)


def test_its_policy_is_evaluated_in_the_papers_task(out: Path, capsys: pytest.CaptureFixture[str]):
    args = ("--objects", "cube_s", "--num-envs", "2", "--trials", "1", "--physics-hz", "60", "--json")
    assert run("evaluate", out, *args) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert (metrics["method"], metrics["trials"]) == ("catch+fit", 2)


def test_it_goes_on_for_its_own_task_alone(out: Path, capsys: pytest.CaptureFixture[str]):
    assert run(*TRAIN, "--task", "nominal", "--out", out, "--resume") == 2
    assert "--task wide" in capsys.readouterr().err
    assert load_policy(out)[0].contract.task == "wide"
    assert run(*TRAIN, "--out", out, "--resume") == 0
    assert load_policy(out)[0].contract.task == "wide"


def test_late_images_are_those_of_nominal_episodes(tmp_path: Path):
    """Fractions of a control step, too; the variants keep their own."""
    out = tmp_path / "run"
    assert run(*TRAIN, "--task", "wide", "--env.sensing.latency-steps", "0.5", "3.5", "--out", out) == 0
    env = json.loads((out / "config.json").read_text())["env"]
    assert env["sensing"]["latency_steps"] == [0.5, 3.5]
    kept = [variant["sensing"]["latency_steps"] for variant in env["variants"]]
    assert kept == [list(variant.sensing.latency_steps) for variant in TASKS["wide"].variants]


def test_the_default_is_the_papers_task(tmp_path: Path):
    torch.manual_seed(0)
    out = tmp_path / "run"
    assert run(*TRAIN, "--out", out) == 0
    assert load_policy(out)[0].contract.task == "nominal"
    assert json.loads((out / "config.json").read_text())["env"]["variants"] == []


def test_training_has_contacts_of_its_own():
    """They are the configuration's, unless the scene's are given."""
    cfg = with_task(preset("cpu"))
    assert (cfg.env.scene.multiccd, CatchEnvCfg().scene.multiccd) == (False, True)
    assert (cfg.cone, cfg.env.scene.cone, CatchEnvCfg().scene.cone) == ("pyramidal", "pyramidal", "elliptic")
    elliptic = with_task(preset("fast"), change=lambda env: replace(env, scene=SceneCfg(cone="elliptic")))
    assert (elliptic.cone, with_task(elliptic).env.scene.cone) == ("elliptic", "elliptic")
    paper = with_task(preset("paper")).env.scene
    assert (paper.cone, paper.multiccd) == ("elliptic", True)


def test_an_unknown_task_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert run(*TRAIN, "--task", "wild", "--out", tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert "unknown task 'wild'" in error
    assert "nominal" in error
    assert "wide" in error
    assert not list(tmp_path.iterdir())


def test_a_training_goes_on_from_a_shipped_policy_by_its_name(tmp_path: Path):
    """Within the transitions in which the value networks alone learn, no weight of the policy moves."""
    task = ("train", "catch+fit", "--preset", "cpu", "--device", "cpu", "--task", "wide")
    small = ("--num-envs", "4", "--rollout-steps", "4", "--transitions", "32", "--env.scene.physics-hz", "30")
    assert run(*task, *small, "--start", "catch+fit", "--out", tmp_path / "run") == 0
    shipped, trained = (Policy.load(policy_folder(path)) for path in (Path("catch+fit"), tmp_path / "run"))
    for (name, before), after in zip(shipped.named_parameters(), trained.parameters(), strict=True):
        assert torch.equal(before, after), name


def test_a_training_from_no_policy_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run(*TRAIN, "--start", "ctach+fit", "--out", tmp_path / "run") != 0
    error = capsys.readouterr().err
    assert "ctach+fit" in error
    assert "catch+fit" in error
    assert not (tmp_path / "run").exists()
