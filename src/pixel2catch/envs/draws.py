"""What is drawn for an episode, and what becomes of it."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.episodes import EpisodeRecord
from pixel2catch.mdp.randomization import EpisodeParameters, sample_command_delay, sample_parameters
from pixel2catch.mdp.shaking import Shake, sample_shake
from pixel2catch.mdp.sight import Sight, sample_sight
from pixel2catch.mdp.throws import Throw, sample_throws
from pixel2catch.robot.objects import OBJECTS
from pixel2catch.robot.scene import SceneCfg


@dataclass(frozen=True, kw_only=True)
class Episode:
    """The present episode of each environment.

    Attributes:
        parameters: Object, dynamics, biases and latency.
        throw: The throw, in the frame of the robot's base.
        sight: What is wrong with the sight; in training only how well the camera is known.
        shake: How the table shakes; it stands still in training.
        command_delay: Control steps between a command and its effect.
        record: What became of the episode so far.
    """

    parameters: EpisodeParameters
    throw: Throw
    sight: Sight | None
    shake: Shake | None
    command_delay: Int[Tensor, " num_envs"]
    record: EpisodeRecord


def draw_episode(
    cfg: CatchEnvCfg, object_ids: Int[Tensor, " num_objects"], num_envs: int, generator: torch.Generator
) -> Episode:
    """Draw an episode for every environment, on the generator's device.

    What not every task disturbs is drawn last, so that a seed throws the same with and without it.
    """
    parameters = sample_parameters(cfg.randomization, cfg.sensing, object_ids, num_envs, generator)
    throw = sample_throws(cfg.throws, num_envs, generator, _drag(cfg.scene, parameters))
    sight = sample_sight(cfg.sensing, throw, generator)
    shake = sample_shake(cfg.shake, num_envs, generator)
    return Episode(
        parameters=parameters,
        throw=throw if shake is None else shake.seen_from_base(throw),
        sight=sight,
        shake=shake,
        command_delay=sample_command_delay(cfg.randomization, num_envs, generator),
        record=EpisodeRecord.start(parameters.object_id, throw.aim),
    )


def _drag(scene: SceneCfg, parameters: EpisodeParameters) -> Float[Tensor, " num_envs"] | None:
    """Mean deceleration of each object by air, over the square of its speed [1/m]; nothing without air."""
    if not scene.air_density:
        return None
    by_object = _drag_by_object(scene, parameters.mass_scale.device)
    return by_object[parameters.object_id] / parameters.mass_scale


@lru_cache(maxsize=8)
def _drag_by_object(scene: SceneCfg, device: torch.device) -> Float[Tensor, " num_objects"]:
    """The same of every object at its own mass, in the order of the object table; copied only once."""
    thrown = [spec.scaled(scene.object_scale) for spec in OBJECTS.values()]
    values = [0.5 * scene.air_density * spec.drag_area / spec.mass for spec in thrown]
    return torch.tensor(values, dtype=torch.float32, device=device)
