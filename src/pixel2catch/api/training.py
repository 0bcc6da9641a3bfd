"""A training, from its options to its run folder; what `pixel2catch train` and `pixel2catch.train` share."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.tasks import find_task
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.train import TrainResult, train
from pixel2catch.methods import Method
from pixel2catch.policy import contract_of
from pixel2catch.scene.objects import largest_radius, select_objects
from pixel2catch.workcells import find_workcell


def with_task(
    cfg: TrainCfg,
    workcell: str | None = None,
    change: Callable[[CatchEnvCfg], CatchEnvCfg] = lambda env: env,
) -> TrainCfg:
    """Return a configuration with its environments: the task's, or the run's, with what was given.

    Args:
        cfg: The configuration.
        workcell: Name of the robots, where they are not the task's.
        change: What else is different of the environments.

    Raises:
        InvalidValueError: If a value is out of range, or a file cannot be read.
        UnknownNameError: If there is no such task, work cell or object.
    """
    env = cfg.env or find_task(cfg.task)
    if workcell:
        env = env.with_workcell(find_workcell(workcell))
    if cfg.env is None:
        env = env.with_files(cfg.dynamics, cfg.camera)
    contacts = replace(env.scene, cone=cfg.cone, multiccd=cfg.multiccd)
    scenes = [replace(contacts, physics_hz=rate) for rate in cfg.physics_hz]
    sensing = replace(env.sensing, latency_steps=cfg.latency_steps)
    env = change(replace(env, scene=scenes[0], sensing=sensing))
    if env.scene.physics_hz != scenes[0].physics_hz:  # a field was given: one rate from begin to end
        scenes = [env.scene]
    return replace(
        cfg,
        env=replace(env, objects=select_objects(env.objects)),
        physics_hz=tuple(scene.physics_hz for scene in scenes),
        latency_steps=env.sensing.latency_steps,
        cone=env.scene.cone,
        multiccd=env.scene.multiccd,
    )


def run(cfg: TrainCfg, method: Method, out: Path, *, resume: bool = False) -> TrainResult:
    """Train a method in the environments of a configuration, to the end.

    Raises:
        Pixel2CatchError: As `learning.train.train`.
    """
    method = method.with_weights(cfg.rewards)
    contract = contract_of(method, find_workcell(cfg.env.scene.workcell), cfg.env.sensing.camera.camera)
    teacher = load_policy(cfg.teacher)[1] if cfg.teacher else None

    def make_env(cfg: TrainCfg) -> CatchEnv:
        scene = replace(cfg.env.scene, physics_hz=cfg.physics_hz[0])
        return CatchEnv(
            replace(cfg.env, scene=scene),
            method,
            num_envs=cfg.num_envs,
            device=cfg.device,
            seed=cfg.seed,
            teacher=teacher,
            is_fused=cfg.fuse,
        )

    radius = largest_radius(cfg.env.objects, cfg.env.scene.object_scale)
    contract = replace(contract, task=cfg.task, object_radius=radius)
    return train(cfg, make_env, contract, out, resume=resume, agents=method.agents)
