"""`--camera FILE` of train, evaluate and play, with the real commands."""

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
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.methods import METHODS
from pixel2catch.policy import Policy, contract_of
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
NOMINAL_TASK = CatchEnvCfg(scene=SceneCfg(physics_hz=30.0))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibrated") / "ours.json"
    MEASURED.save(path)
    return path


def untrained(camera: dict[str, object] | CameraSpec) -> Policy:
    """A policy that was trained for a camera, were it trained."""
    torch.manual_seed(0)
    fields = dataclasses.asdict(camera) if isinstance(camera, CameraSpec) else camera
    return Policy(dataclasses.replace(contract_of(METHODS["proposed"]), camera=fields), hidden=(8,))


def run(*args: str | Path) -> int:
    return main([str(arg) for arg in args])


def test_training_is_for_the_camera_of_the_file(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """What it simulates, what the policy says, and on what terms it goes on."""
    out = tmp_path / "run"
    assert run(*TRAIN, "--out", out, "--camera", file) == 0
    assert (out / "camera.json").read_bytes() == file.read_bytes()
    task = json.loads((out / "config.json").read_text())["env"]
    assert task["sensing"]["camera"] == json.loads(json.dumps(dataclasses.asdict(MEASURED)))
    policy = load_policy(out)[0]
    assert task_of(policy, 30.0) == NOMINAL_TASK.with_camera(CameraFile(camera=CAMERA))
    other = tmp_path / "other.json"
    CameraFile(camera=RGB_CAMERA).save(other)
    assert run(*TRAIN, "--out", out, "--resume", "--camera", other) == 2
    assert "leave out --camera" in capsys.readouterr().err
    assert run(*TRAIN, "--out", out, "--resume") == 0
    assert json.loads((out / "config.json").read_text())["env"] == task


def test_the_task_has_the_camera_of_the_policy_or_of_the_file(file: Path):
    ours, theirs = untrained(CAMERA), untrained(RGB_CAMERA)
    assert task_of(theirs, 30.0) == NOMINAL_TASK
    assert task_of(ours, 30.0) == NOMINAL_TASK.with_camera(CameraFile(camera=CAMERA))
    scene = dataclasses.replace(NOMINAL_TASK.scene, camera=CAMERA)
    seen = dataclasses.replace(NOMINAL_TASK, scene=scene, sensing=SensingCfg(camera=MEASURED))
    assert task_of(ours, 30.0, camera=file) == task_of(theirs, 30.0, camera=file) == seen


def test_what_is_said_of_the_camera(file: Path):
    ours, theirs = untrained(CAMERA), untrained(RGB_CAMERA)
    assert not list(camera_remark(theirs, task_of(theirs)))
    assert "of its own" in next(camera_remark(ours, task_of(ours)))
    assert "of its own" in next(camera_remark(ours, task_of(ours, camera=file)))
    assert "another camera" in next(camera_remark(theirs, task_of(theirs, camera=file)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 1280}, "camera.width: policy 1280, here 640"),
        ({"zoom": 2.0}, "camera.zoom: policy 2.0, here None"),
    ],
)
def test_a_policy_of_other_images_is_refused(change: dict[str, object], words: str, tmp_path: Path):
    untrained(dataclasses.asdict(CAMERA) | change).save(tmp_path)
    with pytest.raises(PolicyMismatchError, match=words):
        load_policy(tmp_path)


@pytest.mark.parametrize("command", [TRAIN, ("evaluate",), ("play",)], ids=lambda command: command[0])
def test_a_bad_file_is_refused_before_anything_is_written(
    command: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bad, large = tmp_path / "bad.json", tmp_path / "large.json"
    bad.write_text('{"format_version": 1, "camera": {}}')
    dataclasses.replace(MEASURED, camera=dataclasses.replace(CAMERA, width=1280)).save(large)
    for path, words in (
        (bad, f"cannot read the camera file '{bad}'"),
        (tmp_path / "none.json", "which is not there"),
        (large, "policies look at 640 x 480"),
    ):
        assert run(*command, "--camera", path, "--out", tmp_path / "out.mp4") == 2
        assert words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.json", "large.json"]
