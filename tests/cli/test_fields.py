"""Fields of the task, camera and dynamics files as options of train, evaluate, play and stress."""

import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.cli.fields import with_given
from pixel2catch.cli.main import main, parse
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import TASKS, find_task
from pixel2catch.errors import PolicyMismatchError, UnknownNameError
from pixel2catch.evaluation.loading import camera_remark, load_policy, task_of
from pixel2catch.installation import install_command
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.mdp.randomization import GainRanges, RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.methods import METHODS, find_method
from pixel2catch.policy import Policy, contract_of
from pixel2catch.robots import ur5e
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.cfg import SceneCfg
from pixel2catch.scene.constants import OBJECT_RADIUS, RGB_CAMERA
from pixel2catch.shipped import policy_folder

THROWS = ("--objects", "cube_s", "--num-envs", "2", "--trials", "1", "--env.scene.physics-hz", "60")
SIZE = ("--num-envs", "4", "--rollout-steps", "2", "--mini-batches", "2", "--transitions", "16")
COARSE = ("--env.scene.physics-hz", "30")
SMALL = ("train", "only_center", "--device", "cpu", *SIZE, "--hidden", "8")
TRAIN = (*SMALL, *COARSE)

CAMERA = replace(RGB_CAMERA, pos=(-0.5, 0.1, 2.1), fx=600.0, fy=601.0)
MEASURED = CameraFile(
    camera=CAMERA,
    pose_covariance=tuple(tuple(1e-4 if i == j else 0.0 for j in range(6)) for i in range(6)),
    focal_std=0.01,
)
ARM = JointDynamics.of(ur5e.ARM.joints).with_values(latency=0.02, filter_gain=300.0, filter_lookahead=0.1)
IDENTIFIED = DynamicsFile(dynamics=ARM, gains=GainRanges(stiffness_scale=((0.99, 1.01),) * 19))
NOMINAL_TASK = CatchEnvCfg(scene=SceneCfg(physics_hz=30.0))


def untrained(**camera: object) -> Policy:
    """A policy for the release's camera with some other values."""
    contract = contract_of(METHODS["proposed"])
    return Policy(replace(contract, camera=contract.camera | camera), hidden=(8,))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fields")
    untrained().save(path)
    MEASURED.save(path / "camera.json")
    IDENTIFIED.save(path / "dynamics.json")
    return path


def run(*args: str | Path) -> int:
    return main([str(arg) for arg in args])


def test_only_given_fields_change_a_task():
    """A given value counts even where it is the default of the paper's task."""
    wide = replace(find_task("wide"), scene=SceneCfg(physics_hz=600.0))
    given = CatchEnvCfg(objects=("cube_s",))
    changed = with_given(wide, given, ("scene.physics_hz", "objects"))
    assert changed == replace(wide, scene=SceneCfg(physics_hz=120.0), objects=("cube_s",))


@pytest.mark.usefixtures("small_cells")
def test_a_field_holds_beneath_every_disturbance(folder: Path, tmp_path: Path):
    command = ["stress", folder, *THROWS, "--axes", "air", "--out", tmp_path / "stress"]
    assert run(*command, "--env.sensing.drop-rate", "0.1", "0.2") == 0
    for file in (tmp_path / "stress" / "cells").rglob("*.json"):
        task = json.loads(file.read_text())["evaluation"]["task"]
        assert task["sensing"]["drop_rate"] == [0.1, 0.2]
        assert task["randomization"]["air_density"] == 1.2
    assert run(*command) == 2  # the results that are there are of another task


@pytest.mark.parametrize("command", ["evaluate", "play", "stress"])
def test_wrong_fields_are_named(command: str, folder: Path, tmp_path: Path, capsys, opengl: None):
    """Those that are misspelt, and those that the protocol of evaluations sets."""
    with pytest.raises(SystemExit):
        parse([command, "--env.throws.peak", "1", "2"])
    assert "throws.peak-z" in capsys.readouterr().err
    assert run(command, folder, "--out", tmp_path / "out.mp4", "--env.objects", "cross") == 2
    assert "--env.objects" in capsys.readouterr().err


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
    assert run(*TRAIN, "--wandb", "catching", "--out", out) == 0
    number = (out / "wandb.id").read_text()
    (folder,) = (out / "wandb").glob("offline-run-*")
    wanted, written, tries = (b"reward_term/arm.success", b"initial_log_std"), b"", 0
    while not all(name in written for name in wanted) and tries < 600:  # its own process writes the file
        tries += 1
        time.sleep(0.1)
        written = (folder / f"run-{number}.wandb").read_bytes()
    assert all(name in written for name in wanted)


WRONG_MODE_THEN_NO_KEY = """
import os, sys
from pixel2catch.cli.main import main
os.environ["WANDB_MODE"] = "nonsense"
assert main(sys.argv[1:]) == 2
del os.environ["WANDB_MODE"]
sys.exit(main(sys.argv[1:]))
"""


def test_without_a_key_or_mode_of_weights_and_biases_nothing_is_left(tmp_path: Path):
    """In a process of its own, because the package keeps the mode of earlier runs."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WANDB_")}
    options = ("--wandb", "catching", "--out", "new/run")
    command = [sys.executable, "-c", WRONG_MODE_THEN_NO_KEY, *TRAIN, *options]
    environment |= {"HOME": str(tmp_path)}
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    wrong_mode, no_key = done.stderr.split("set WANDB_MODE=offline.")[:2]
    assert "nonsense" in wrong_mode
    assert "No API key" in no_key
    assert not (tmp_path / "new").exists()


def test_a_missing_package_is_named_before_anything_is_written(tmp_path: Path, monkeypatch, refusal: Any):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert install_command("wandb") in refusal(*TRAIN, "--wandb", "catching", "--out", tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_training_simulates_what_the_files_describe(folder: Path, tmp_path: Path, refusal: Any):
    """The run keeps their values, the policy is for the camera, and the run goes on with no other files."""
    out, names = tmp_path / "run", ("dynamics", "camera")
    files = [part for name in names for part in (f"--{name}", folder / f"{name}.json")]
    assert run(*TRAIN, "--out", out, *files, "--env.sensing.latency-steps", "1", "3") == 0
    task = json.loads((out / "config.json").read_text())["env"]
    assert task["sensing"]["camera"] == json.loads(json.dumps(asdict(MEASURED)))
    assert task["sensing"]["latency_steps"] == [1, 3]
    assert task["dynamics"]["latency"] == [0.02] * 6
    assert task["randomization"]["gains"]["stiffness_scale"] == [[0.99, 1.01]] * 6 + [[0.7, 1.3]] * 13
    assert task_of(load_policy(out)[0], 30.0) == NOMINAL_TASK.with_camera(CameraFile(camera=CAMERA))
    other = tmp_path / "other.json"
    DynamicsFile().save(other)
    assert "leave out --dynamics" in refusal(*TRAIN, "--out", out, "--resume", "--dynamics", other)
    assert run(*TRAIN, "--out", out, "--resume", *files) == 0
    assert json.loads((out / "config.json").read_text())["env"] == task


def test_the_task_of_a_policy_has_its_camera_or_that_of_the_files(folder: Path):
    ours, theirs, file = untrained(**asdict(CAMERA)), untrained(), folder / "camera.json"
    assert task_of(theirs, 30.0) == NOMINAL_TASK
    assert task_of(ours, 30.0) == NOMINAL_TASK.with_camera(CameraFile(camera=CAMERA))
    scene = replace(NOMINAL_TASK.scene, camera=CAMERA)
    seen = replace(NOMINAL_TASK, scene=scene, sensing=SensingCfg(camera=MEASURED))
    assert task_of(ours, 30.0, camera=file) == task_of(theirs, 30.0, camera=file) == seen
    gains = RandomizationCfg(gains=DynamicsFile.load(folder / "dynamics.json").gains)
    robot = replace(NOMINAL_TASK, dynamics=ARM, randomization=gains)
    assert task_of(theirs, 30.0, folder / "dynamics.json") == robot
    for policy, camera, remark in (
        (ours, None, "its own"),
        (ours, file, "its own"),
        (theirs, file, "another"),
    ):
        assert remark in next(camera_remark(policy, task_of(policy, camera=camera)))
    assert not list(camera_remark(theirs, task_of(theirs)))
    bent = task_of(theirs).with_camera(replace(MEASURED, camera=RGB_CAMERA, distortion=(0.1, 0.0, 0.0, 0.0)))
    assert "rectified" in next(camera_remark(theirs, bent))


@pytest.mark.parametrize(("change", "words"), [({"width": 1280}, "camera.width"), ({"zoom": 2.0}, "zoom")])
def test_a_policy_of_other_images_is_refused(change: dict[str, object], words: str, tmp_path: Path):
    untrained(**change).save(tmp_path)
    with pytest.raises(PolicyMismatchError, match=words):
        load_policy(tmp_path)


LATE = ("--env.sensing.latency-steps", "1", "3", "--env.throws.hover-steps", "7", "7")


def test_what_is_set_reaches_the_environment(capsys: pytest.CaptureFixture[str]):
    cfg = parse([*SMALL, "--task", "wide", "--env.variants.0.share=0.5", *LATE]).env
    assert [variant.share for variant in cfg.variants] == [0.5, 0.2, 0.2, 0.1]
    assert "--env.sensing.latency-steps leaves out 4 variants" in capsys.readouterr().err
    assert cfg.variants[0].sensing == TASKS["wide"].variants[0].sensing
    env = CatchEnv(replace(cfg, variants=()), METHODS["only_center"], num_envs=64)
    assert set(env.episode.parameters.latency.tolist()) == {1.0, 2.0, 3.0}
    assert set(env.episode.throw.hover_steps.tolist()) == {7}
    env.close()


def test_a_given_physics_rate_holds_throughout():
    command = parse([*SMALL, "--env.scene.physics-hz", "120"])
    assert (command.train.physics_stages, command.env.scene.physics_hz) == ((), 120.0)
    assert command.train.rate_at(0) is None
    assert parse([*SMALL, "--physics-stages", "60", "120"]).train.physics_stages == (60.0, 120.0)
    assert len(parse(SMALL).train.physics_stages) == 6


@pytest.fixture(scope="module")
def wide_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run for the wide task, with a latency and weights of its own."""
    out = tmp_path_factory.mktemp("own") / "run"
    own = ("--task", "wide", "--preset", "cpu", "--physics-stages", "30", "60")
    assert run(*SMALL, *LATE, *own, "--out", out) == 0
    return out


def test_a_run_goes_on_with_its_own_configuration(wide_run: Path, refusal: Any):
    before, out = json.loads((wide_run / "config.json").read_text()), ("--out", wide_run)
    for wrong in (("--task", "nominal"), ("--workcell", "ur5e_leap"), ("--preset", "fast")):
        assert wrong[1] in refusal(*SMALL, *wrong, "--resume", *out)
    assert "only_center" in refusal("train", "proposed", "--resume", *out)
    assert run("train", "--task", "wide", "--resume", "--transitions", "24", *out) == 0
    after = json.loads((wide_run / "config.json").read_text())
    assert (before["train"].pop("transitions"), after["train"].pop("transitions")) == (16, 24)
    assert after == before


@pytest.mark.usefixtures("small_cells")
def test_a_policy_is_of_its_task_and_is_evaluated_in_the_papers(wide_run: Path, capsys):
    policy, _ = load_policy(wide_run)
    assert (policy.contract.task, policy.contract.object_radius) == ("wide", OBJECT_RADIUS)
    assert run("evaluate", wide_run, *THROWS, "--json") == 0
    metrics = json.loads(capsys.readouterr().out)
    assert (metrics["method"], metrics["trials"]) == ("only_center", 2)


def test_a_run_records_terms_and_weights_of_its_agents(tmp_path: Path):
    out = tmp_path / "run"
    rewards = ("--rewards", "arm.success", "5", "arm.drop", "0")
    assert run(*TRAIN, *rewards, "--out", out) == 0
    config = json.loads((out / "config.json").read_text())
    assert config["train"]["rewards"] == {"arm.success": 5.0, "arm.drop": 0.0}
    assert config["env"]["name"] == "nominal"
    assert list(config["agents"]) == [agent.name for agent in find_method("only_center").agents]
    assert config["agents"]["arm"]["observation"] == ["pixels", "palm_pose", "joint_pos", "last_action"]
    weights = config["agents"]["arm"]["rewards"]
    assert [weights[f"arm.{name}"] for name in ("success", "drop", "nearness")] == [5.0, 0.0, 0.1]
    text = (out / "summary.json").read_text()  # no episode has ended: rates are null, not NaN
    assert json.loads(text, parse_constant=pytest.fail)["metrics"]["success_rate"] is None


def test_a_training_goes_on_from_a_shipped_policy_by_its_name(tmp_path: Path):
    """Within the transitions in which the value networks alone learn, no weight of the policy moves."""
    name, out = "catch_alone+fit", tmp_path / "run"
    teachers = ("--teacher", "object_position", "--start", name)
    assert run("train", name, "--device", "cpu", *SIZE, *COARSE, "--out", out, *teachers) == 0
    shipped, trained = (Policy.load(policy_folder(path)) for path in (Path(name), out))
    for (name, before), after in zip(shipped.named_parameters(), trained.parameters(), strict=True):
        assert torch.equal(before, after), name
