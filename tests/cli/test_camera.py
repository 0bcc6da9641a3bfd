"""`--camera FILE` and `--dynamics FILE` of train, evaluate and play."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.cli.main import main
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import PolicyMismatchError
from pixel2catch.evaluation.loading import camera_remark, load_policy, task_of
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.mdp.randomization import GainRanges, RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.methods import METHODS
from pixel2catch.policy import Policy, contract_of
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec
from pixel2catch.scene.scene import SceneCfg

SIZE = ("--num-envs", "4", "--rollout-steps", "4", "--transitions", "32", "--hidden", "8")
TRAIN = ("train", "only_center", "--device", "cpu", *SIZE, "--env.scene.physics-hz", "30")
CAMERA = dataclasses.replace(RGB_CAMERA, pos=(-0.5, 0.1, 2.1), fx=600.0, fy=601.0)
MEASURED = CameraFile(
    camera=CAMERA,
    pose_covariance=tuple(tuple(1e-4 if i == j else 0.0 for j in range(6)) for i in range(6)),
    focal_std=0.01,
)
ARM = JointDynamics.nominal(JointDynamics.nominal().joints[:6]).with_values(
    latency=0.02, filter_gain=300.0, filter_lookahead=0.1
)
IDENTIFIED = DynamicsFile(dynamics=ARM, gains=GainRanges(stiffness_scale=((0.99, 1.01),) * 19))
NOMINAL_TASK = CatchEnvCfg(scene=SceneCfg(physics_hz=30.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("measured")
    MEASURED.save(path / "camera.json")
    IDENTIFIED.save(path / "dynamics.json")
    return path


def untrained(camera: dict[str, object] | CameraSpec) -> Policy:
    """A policy that was trained for a camera, were it trained."""
    torch.manual_seed(0)
    fields = dataclasses.asdict(camera) if isinstance(camera, CameraSpec) else camera
    return Policy(dataclasses.replace(contract_of(METHODS["proposed"]), camera=fields), hidden=(8,))


def run(*args: str | Path) -> int:
    return main([str(arg) for arg in args])


def test_training_simulates_what_the_files_describe(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The run keeps their values, the policy is for the camera, and the run goes on with no other files."""
    out, names = tmp_path / "run", ("dynamics", "camera")
    files = [part for name in names for part in (f"--{name}", folder / f"{name}.json")]
    assert run(*TRAIN, "--out", out, *files, "--env.sensing.latency-steps", "1", "3") == 0
    task = json.loads((out / "config.json").read_text())["env"]
    assert task["sensing"]["camera"] == json.loads(json.dumps(dataclasses.asdict(MEASURED)))
    assert task["sensing"]["latency_steps"] == [1, 3]
    assert task["dynamics"]["latency"] == [0.02] * 6
    assert task["randomization"]["gains"]["stiffness_scale"] == [[0.99, 1.01]] * 6 + [[0.7, 1.3]] * 13
    assert task_of(load_policy(out)[0], 30.0) == NOMINAL_TASK.with_camera(CameraFile(camera=CAMERA))
    other = tmp_path / "other.json"
    DynamicsFile().save(other)
    assert run(*TRAIN, "--out", out, "--resume", "--dynamics", other) == 2
    assert "leave out --dynamics" in capsys.readouterr().err
    assert run(*TRAIN, "--out", out, "--resume", *files) == 0
    assert json.loads((out / "config.json").read_text())["env"] == task


def test_the_task_of_a_policy_has_its_camera_or_that_of_the_files(folder: Path):
    ours, theirs = untrained(CAMERA), untrained(RGB_CAMERA)
    assert task_of(theirs, 30.0) == NOMINAL_TASK
    assert task_of(ours, 30.0) == NOMINAL_TASK.with_camera(CameraFile(camera=CAMERA))
    scene = dataclasses.replace(NOMINAL_TASK.scene, camera=CAMERA)
    seen = dataclasses.replace(NOMINAL_TASK, scene=scene, sensing=SensingCfg(camera=MEASURED))
    file = folder / "camera.json"
    assert task_of(ours, 30.0, camera=file) == task_of(theirs, 30.0, camera=file) == seen
    gains = RandomizationCfg(gains=DynamicsFile.load(folder / "dynamics.json").gains)
    robot = dataclasses.replace(NOMINAL_TASK, dynamics=ARM, randomization=gains)
    assert task_of(theirs, 30.0, folder / "dynamics.json") == robot


def test_what_is_said_of_the_camera(folder: Path):
    ours, theirs, file = untrained(CAMERA), untrained(RGB_CAMERA), folder / "camera.json"
    assert not list(camera_remark(theirs, task_of(theirs)))
    assert "of its own" in next(camera_remark(ours, task_of(ours)))
    assert "of its own" in next(camera_remark(ours, task_of(ours, camera=file)))
    assert "another camera" in next(camera_remark(theirs, task_of(theirs, camera=file)))


@pytest.mark.parametrize(("change", "words"), [({"width": 1280}, "camera.width"), ({"zoom": 2.0}, "zoom")])
def test_a_policy_of_other_images_is_refused(change: dict[str, object], words: str, tmp_path: Path):
    untrained(dataclasses.asdict(CAMERA) | change).save(tmp_path)
    with pytest.raises(PolicyMismatchError, match=words):
        load_policy(tmp_path)


@pytest.mark.parametrize("command", [TRAIN, ("evaluate",), ("play",)], ids=lambda command: command[0])
def test_a_bad_file_is_refused_before_anything_is_written(
    command: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bad, large = tmp_path / "bad.json", tmp_path / "large.json"
    bad.write_text('{"format_version": 1}')
    dataclasses.replace(MEASURED, camera=dataclasses.replace(CAMERA, width=1280)).save(large)
    for option, path in (
        ("--camera", bad),
        ("--dynamics", bad),
        ("--dynamics", tmp_path / "none.json"),
        ("--camera", large),
    ):
        assert run(*command, option, path, "--out", tmp_path / "out.mp4") == 2
        error = capsys.readouterr().err
        assert "640 x 480" in error if path == large else f"'{path}'" in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.json", "large.json"]
