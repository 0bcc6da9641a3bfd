"""The configuration of a training: its environments and how it learns, by a preset or from a run folder."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from pixel2catch.checks import require_valid
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.errors import CheckpointError, InvalidValueError, UnknownNameError
from pixel2catch.files import decoded, read_json_object, reading
from pixel2catch.learning.config import CONFIG_FILE, PRESETS, PresetName, TrainCfg
from pixel2catch.mdp.sensing import RELEASE_CAMERA
from pixel2catch.policy import Policy
from pixel2catch.shipped import policy_folder
from pixel2catch.workcells import find_workcell

FAST_CONTACTS: dict[str, Any] = {"cone": "pyramidal", "multiccd": False}
"""Contacts of named tasks in training, except with the preset `paper`: faster to compute, and policies learn
as much with them. Evaluations have elliptic cones and several points. Source: ours."""

LARGE_BYTES = 16 * 2**30
"""Memory [bytes] from which several GPUs have the preset large. Source: ours, from bench_h100.json."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Everything that defines a training, except its method."""

    env: CatchEnvCfg  #: The environments.
    train: TrainCfg  #: How the policy learns.
    __post_init__ = require_valid


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """What a run folder records of its training."""

    experiment: Experiment
    method: str  #: Name of the method.
    preset: str | None  #: Name of the preset; None where Python gave the experiment itself.


def preset_for(device: str) -> PresetName:
    """Return the preset for a device: cpu, fast on a GPU, large in torchrun's processes on large GPUs."""
    if not device.startswith("cuda"):
        return "cpu"
    is_several = int(os.environ.get("WORLD_SIZE", "1")) > 1 and torch.cuda.is_available()
    is_large = is_several and torch.cuda.get_device_properties(0).total_memory >= LARGE_BYTES
    return "large" if is_large else "fast"


def preset(
    name: str = "fast",
    task: str | CatchEnvCfg = "nominal",
    *,
    workcell: str | None = None,
    dynamics: Path | None = None,
    camera: Path | None = None,
    **options: Any,
) -> Experiment:
    """Return the experiment of a preset.

    A named task gets the contacts and the stages of physics rates of the preset; a `CatchEnvCfg` is used as
    it is, at its own physics rate.

    Args:
        name: fast, large, cpu or paper.
        task: A task or its name.
        workcell: Name of the robots. Default: the task's.
        dynamics: Dynamics file of the robot, as `identify` writes it.
        camera: Camera file, as `calibrate` writes it.
        **options: Fields of `TrainCfg` that differ from the preset. With `start`, the networks have the sizes
            of that policy.

    Raises:
        Pixel2CatchError: A name is unknown, a value is out of range, or a file cannot be read.
    """
    if name not in PRESETS:
        raise UnknownNameError("preset", name, PRESETS)
    env = find_task(task) if isinstance(task, str) else task
    if isinstance(task, str) and name != "paper":
        env = replace(env, scene=replace(env.scene, **FAST_CONTACTS))
    if not isinstance(task, str):
        options = {"physics_stages": ()} | options
    if workcell is not None:
        env = env.with_workcell(find_workcell(workcell))
    if options.get("start"):
        options = {"hidden": Policy.load(policy_folder(Path(options["start"]))).hidden} | options
    train = PRESETS[name].changed(options)
    has_camera = env.sensing.camera != RELEASE_CAMERA
    if (dynamics and env.dynamics) or (camera and has_camera):
        raise InvalidValueError(f"the task has the values of '{dynamics or camera}' already; leave out one.")
    return Experiment(env=env.with_files(dynamics, camera), train=train)


def read_run(folder: Path) -> RunRecord:
    """Read the configuration of a run folder; raise CheckpointError if it does not fit this code."""
    file = folder / CONFIG_FILE
    fix = "Resume with the version that wrote it, or start another run."
    with reading("configuration", file, fix, CheckpointError):
        content = read_json_object(file)
        experiment = decoded(Experiment, {name: content[name] for name in ("env", "train")})
        find_workcell(experiment.env.scene.workcell)
        return RunRecord(experiment=experiment, method=content["policy"]["method"], preset=content["preset"])


def require_run(
    folder: Path, dynamics: Path | None = None, camera: Path | None = None, **given: str | None
) -> RunRecord:
    """Read the run that goes on; raise CheckpointError if it was started with something else than is given.

    `given` are names by option: method, preset, task, workcell; None where an option or a file is not given.
    """
    if not (folder / CONFIG_FILE).is_file():
        raise CheckpointError(f"'{folder}' holds no run to resume; start without --resume.")
    run = read_run(folder)
    env = run.experiment.env
    found = {"method": run.method, "preset": run.preset, "task": env.name, "workcell": env.scene.workcell}
    for name, value in given.items():
        if value not in (None, found[name]):
            before = (
                f"is a run of the {name} '{found[name]}'" if found[name] else f"is a run without a {name}"
            )
            raise CheckpointError(
                f"'{folder}' {before}, and '{value}' is given; leave out the {name}, or name another folder."
            )
    tasks = {"dynamics": env.with_files(dynamics, None), "camera": env.with_files(None, camera)}
    for name, task in tasks.items():
        if task != env:
            raise CheckpointError(
                f"'{folder}' is a run with another {name} file, or none; leave out --{name}, or name another "
                "folder."
            )
    return run
