"""Reading policies, and the task in which they act."""

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

from pixel2catch.camera import region
from pixel2catch.camera.camera_file import CameraFile
from pixel2catch.checks import PhysicsRate
from pixel2catch.envs.catch_env import CatchEnvCfg
from pixel2catch.methods import Method
from pixel2catch.policy import Policy, analytic, contract_of, method_of
from pixel2catch.policy.analytic import AnalyticPolicy
from pixel2catch.policy.onnx_policy import load
from pixel2catch.policy.policy import WEIGHTS_FILE
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.shipped import is_computed, policy_folder
from pixel2catch.workcells import find_workcell

PHYSICS_HZ = 600.0
"""Physics rate of evaluations [Hz]. Source: ours, five times the paper's rate of training.

An object of 4.5 m/s moves 38 mm in a physics step at 120 Hz, and 8 mm at 600 Hz, before its contact is found.
"""


def load_policy(folder: Path | None, device: str = "cpu") -> tuple[Policy, Method]:
    """Read a policy (see `policy_folder`) and its method.

    Raises PolicyMismatchError for another robot, image size or format, or a method that neither this package
    nor the contract defines. The camera may differ from the release's, see `task_of`.
    """
    found = policy_folder(folder)
    policy = AnalyticPolicy(str(found)).to(device) if is_computed(found) else load(found, device)
    workcell = find_workcell(policy.contract.workcell)
    method = method_of(policy.contract)
    expected, trained = contract_of(method, workcell), policy.contract.camera
    size = {name: expected.camera[name] for name in ("width", "height")}
    camera = {name: trained.get(name, value) for name, value in expected.camera.items()} | size
    policy.contract.require(replace(expected, camera=camera))
    return policy, method


def fingerprint(folder: Path | None) -> str:
    """Return the SHA-256 of the networks of a policy, or of what computes it, by which results name it."""
    found = policy_folder(folder)
    if is_computed(found):
        return sha256(Path(analytic.__file__))
    return sha256(found / WEIGHTS_FILE if found.is_dir() else found)


def sha256(file: Path) -> str:
    """Return the SHA-256 of a file, or the name of a camera that has none."""
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.exists() else str(file)


def task_of(
    policy: Policy,
    physics_hz: PhysicsRate = PHYSICS_HZ,
    dynamics: Path | None = None,
    camera: Path | None = None,
) -> CatchEnvCfg:
    """Return the paper's task with the robot and the camera that a policy was trained with.

    Args:
        policy: The policy.
        physics_hz: Physics rate [Hz].
        dynamics: Dynamics file of the robot. Default: the nominal robot, also for a policy that was trained
            with such a file.
        camera: Camera file, in place of the policy's camera.
    """
    task = CatchEnvCfg(scene=SceneCfg(workcell=policy.contract.workcell, physics_hz=physics_hz))
    return task.with_camera(CameraFile(camera=_camera_of(policy))).with_files(dynamics, camera)


def camera_remark(policy: Policy, task: CatchEnvCfg) -> Iterator[str]:
    """Yield a remark on the camera if it is not the release's, or not one of the training's region."""
    method, file, trained = method_of(policy.contract), task.sensing.camera, _camera_of(policy)
    yield from region_remark(method, file.camera)
    if any(file.distortion):
        yield "the distortion of the camera's lens is not simulated: policies need rectified images"
    if (file.camera != trained or task.sensing.any_camera) and not method.is_levelled:
        yield "the policy was trained for another camera: this is what the change does to it"
    elif trained != RGB_CAMERA and not method.is_levelled:
        yield "the policy was trained for a camera of its own, and sees by that"


def region_remark(method: Method, camera: CameraSpec) -> Iterator[str]:
    """Yield a remark if a method is for any camera of a region and the camera is outside it."""
    if method.is_levelled and (outside := region.outside(camera)):
        yield f"the camera is outside the region of the policy's training: {outside}"


def _camera_of(policy: Policy) -> CameraSpec:
    """Return the camera of a policy's training; the release's of a policy for any camera."""
    return CameraSpec(**(asdict(RGB_CAMERA) | cast(dict[str, Any], policy.contract.camera)))
