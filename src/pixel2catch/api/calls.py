"""The commands as functions: make environments, load, train and evaluate policies.

A wrong name or value raises a `Pixel2CatchError` that names what is valid.
"""

import copy
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

from pixel2catch.api.threads import let_torch_sleep
from pixel2catch.checks import Device, PhysicsRate, require
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.errors import CheckpointError, InvalidValueError
from pixel2catch.evaluation import loading
from pixel2catch.evaluation.metrics import Metrics, assess
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.experiment import Experiment, read_run, require_run
from pixel2catch.learning.experiment import preset as preset_of
from pixel2catch.learning.log import wandb_package
from pixel2catch.learning.train import TrainResult
from pixel2catch.learning.train import train as train_policy
from pixel2catch.methods import Method, find_method
from pixel2catch.own_files import add, import_files
from pixel2catch.policy import Policy, contract_of, method_of
from pixel2catch.policy.contract import unmeasured_terms
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.objects import ObjectSpec, largest_radius, select_objects
from pixel2catch.shipped import policy_folder
from pixel2catch.sim.factory import require_cuda
from pixel2catch.workcells import find_workcell

Objects = str | ObjectSpec | Sequence[str | ObjectSpec]


def make(
    method: str | Method = "proposed",
    *,
    num_envs: int = 1,
    task: str | CatchEnvCfg = "nominal",
    objects: Objects | None = None,
    workcell: str | WorkcellSpec | None = None,
    device: Device = "cpu",
    seed: int = 0,
) -> CatchEnv:
    """Make environments that act on tensors; the views for other libraries wrap them.

    Args:
        method: A method or its name, such as "single_agent" or "catch+fit".
        num_envs: How many robots catch side by side.
        task: A task or its name: nominal, wide, ...
        objects: What is thrown: seen, unseen, real, sizes, names, or your own objects. Default: the task's.
        workcell: The robots, or their name. Default: the task's.
        device: Where to simulate: cpu, cuda, cuda:1, ...
        seed: Seed of everything that is drawn.
    """
    let_torch_sleep()
    cfg = find_task(task) if isinstance(task, str) else task
    if workcell is not None:
        cfg = cfg.with_workcell(find_workcell(_known(workcell)))
    if objects is not None:
        cfg = replace(cfg, objects=_selected(objects))
    return CatchEnv(cfg, _method(method, cfg), num_envs=num_envs, device=device, seed=seed)


def load_policy(name: str | Path | None = None, device: Device = "cpu") -> Policy:
    """Read a policy: a shipped one by name (default: catch_alone+fit), or from its folder or its run's."""
    require_cuda(device)
    return loading.load_policy(None if name is None else Path(name), device)[0]


def evaluate(
    policy: Policy | str | Path | None = None,
    method: Method | None = None,
    *,
    objects: Objects = "seen",
    num_envs: int = 100,
    trials: int = 10,
    seed: int = 0,
    device: Device = "cpu",
    physics_hz: PhysicsRate = loading.PHYSICS_HZ,
    change: Callable[[CatchEnvCfg], CatchEnvCfg] = lambda task: task,
) -> Metrics:
    """Evaluate a policy as `pixel2catch evaluate --json` does; the same numbers, by name.

    Args:
        policy: A policy, or what `load_policy` takes.
        method: Its method, where neither the package nor the policy's contract defines it.
        objects: What is thrown: seen, unseen, real, sizes, names of objects, or your own objects.
        num_envs: Throws in a round.
        trials: Rounds.
        seed: Seed of everything that is drawn.
        device: Where to simulate.
        physics_hz: Physics steps in a second, a multiple of 30.
        change: Changes the task, such as the `change` of a `Level`.
    """
    let_torch_sleep()
    require_cuda(device)
    policy = copy.deepcopy(policy if isinstance(policy, Policy) else load_policy(policy)).to(device)
    method, contract = method or method_of(policy.contract), policy.contract
    here = contract_of(method, find_workcell(contract.workcell))
    contract.require(replace(here, camera=contract.camera))
    cfg = EvaluationCfg(
        objects=_selected(objects),
        num_envs=num_envs,
        trials=trials,
        seed=seed,
        device=device,
        task=change(loading.task_of(policy, physics_hz)),
    )
    for remark in loading.camera_remark(policy, cfg.task):
        warnings.warn(remark, stacklevel=2)
    return assess(policy, method, cfg)


def train(
    method: str | Method,
    out: str | Path,
    *,
    preset: str | Experiment | None = None,
    task: str | CatchEnvCfg | None = None,
    workcell: str | WorkcellSpec | None = None,
    dynamics: str | Path | None = None,
    camera: str | Path | None = None,
    resume: bool = False,
    **options: Any,
) -> TrainResult:
    """Train a policy as `pixel2catch train` does; it is in the folder `policy` of the run.

    Args:
        method: A method or its name.
        out: Folder of the run.
        preset: Where the options come from that are not given: an experiment, or fast, large, cpu or paper.
            Default: cpu.
        task: A task, which is used as it is, or its name. Default: nominal.
        workcell: The robots, or their name. Default: the task's.
        dynamics: Dynamics file of the robot that is simulated. Default: the nominal robot.
        camera: Camera file of the camera that is simulated. Default: the release's.
        resume: Go on from the last checkpoint in the folder, with its configuration and the given options.
        **options: Fields of `TrainCfg`, such as `transitions=1_000_000` or `hidden=(64, 64)`.
    """
    let_torch_sleep()
    given = {"dynamics": dynamics, "camera": camera}
    files = {key: Path(file) for key, file in given.items() if file is not None}
    options |= {key: Path(options[key]) for key in ("start", "teacher") if isinstance(options.get(key), str)}
    cell, name = _known(workcell) if workcell else None, preset if isinstance(preset, str) else None
    if resume:
        if isinstance(preset, Experiment) or isinstance(task, CatchEnvCfg):
            raise InvalidValueError("resume is given with an experiment or a task; leave that out.")
        method_name = method.name if isinstance(method, Method) else method
        names = {"method": method_name, "preset": name, "task": task, "workcell": cell}
        run_there = require_run(Path(out), files.get("dynamics"), files.get("camera"), **names)
        experiment, name = run_there.experiment, run_there.preset
    elif isinstance(preset, Experiment):
        if (task, workcell, dynamics, camera) != (None, None, None, None):
            raise InvalidValueError("an experiment is given; leave out task, workcell, dynamics and camera.")
        experiment = preset
    else:
        name = name or "cpu"
        experiment = preset_of(name, "nominal" if task is None else task, workcell=cell, **files, **options)
    experiment = replace(experiment, train=experiment.train.changed(options))
    training = prepared(experiment, method, resume=resume)
    return run(training, Path(out), resume=resume, preset=name)


class Prepared(NamedTuple):
    """A training that has been checked."""

    cfg: TrainCfg
    env: CatchEnvCfg
    method: Method
    teacher: Method | None


def prepared(experiment: Experiment, method: str | Method, *, resume: bool = False) -> Prepared:
    """Return a training with the names in it resolved; raise what is wrong with it, before any work."""
    cfg, env = experiment.train, experiment.env
    env = replace(env, objects=select_objects(env.objects))
    env = env.for_workcell(find_workcell(env.scene.workcell))
    method = _method(method, env).with_weights(cfg.rewards)
    if cfg.start and not resume:
        policy_folder(cfg.start)  # before anything is built
    if cfg.wandb:
        wandb_package()
    teacher = loading.load_policy(cfg.teacher)[1] if cfg.teacher else None
    method.require_same_view(teacher)
    return Prepared(cfg, env, method, teacher)


def run(training: Prepared, out: Path, *, resume: bool = False, preset: str | None = None) -> TrainResult:
    """Train a method to the end; the run folder records the name of the preset."""
    cfg, env, method, teacher = training
    before = read_run(out).experiment.train if resume else cfg
    for name in ("start", "hidden", "initial_log_std"):
        if getattr(cfg, name) != getattr(before, name):
            raise CheckpointError(f"'{out}' began with another {name}; leave it out, or name another folder.")
    workcell = find_workcell(env.scene.workcell)

    def make_env(share: TrainCfg, physics_hz: float | None) -> CatchEnv:
        rate = physics_hz or env.scene.physics_hz
        return CatchEnv(
            replace(env, scene=replace(env.scene, physics_hz=rate)),
            method,
            num_envs=share.num_envs,
            device=share.device,
            seed=share.seed,
            teacher=teacher,
            is_fused=share.fuse,
        )

    contract = replace(
        contract_of(method, workcell, env.sensing.camera.camera),
        task=env.name,
        object_radius=largest_radius(env.objects, env.scene.object_scale),
    )
    agents = {agent.name: agent.to_dict() for agent in method.agents}
    record = {"env": asdict(env), "agents": agents, "preset": preset}
    terms = ", ".join(dict.fromkeys(unmeasured_terms(method, workcell)))
    remark = f"\nobserves the object in 3D, by {terms}: for comparisons, 'deploy' refuses it" if terms else ""
    return train_policy(cfg, make_env, contract, out, resume=resume, record=record, remark=remark)


def _method(method: str | Method, cfg: CatchEnvCfg) -> Method:
    workcell = find_workcell(cfg.scene.workcell)
    return method if isinstance(method, Method) else find_method(_known(method), workcell)


def _selected(objects: Objects) -> tuple[str, ...]:
    several = objects if isinstance(objects, Sequence) and not isinstance(objects, str) else [objects]
    return select_objects(map(_known, several))


def _known(value: Any) -> str:
    """Return a name, or the name of a value, which joins its catalogue."""
    require(str | Method | ObjectSpec | WorkcellSpec, "name", value)
    name = value if isinstance(value, str) else add(value)
    import_files()
    return name
