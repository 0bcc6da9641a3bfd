"""A training, from its options to its run folder; what `pixel2catch train` and `pixel2catch.train` share."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

from pixel2catch.checks import require_valid
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.evaluation.loading import load_policy
from pixel2catch.learning.config import TrainCfg
from pixel2catch.learning.experiment import Experiment
from pixel2catch.learning.train import TrainResult, train
from pixel2catch.methods import Method
from pixel2catch.policy import contract_of
from pixel2catch.scene.objects import largest_radius, select_objects
from pixel2catch.shipped import policy_folder
from pixel2catch.workcells import find_workcell


def run(
    experiment: Experiment,
    method: Method,
    out: Path,
    *,
    resume: bool = False,
    preset: str | None = None,
    inputs: Mapping[str, Path | None] | None = None,
) -> TrainResult:
    """Train a method to the end.

    The run folder records the name of the preset, and keeps copies of the inputs: files by option.

    Raises:
        Pixel2CatchError: As `learning.train.train`.
    """
    require_valid(experiment)
    cfg, env = experiment.train, experiment.env
    env = replace(env, objects=select_objects(env.objects))
    workcell = find_workcell(env.scene.workcell)
    env = env.for_workcell(workcell)
    method = method.with_weights(cfg.rewards)
    if cfg.start and not resume:
        policy_folder(cfg.start)  # before anything is built
    teacher = load_policy(cfg.teacher)[1] if cfg.teacher else None

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
    return train(cfg, make_env, contract, out, resume=resume, inputs=inputs, record=record)
