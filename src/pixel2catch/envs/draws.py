"""What is drawn for an episode, and what becomes of it."""

from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pixel2catch.device_constants import constant
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.episodes import EpisodeRecord
from pixel2catch.mdp.masks import select
from pixel2catch.mdp.randomization import (
    EpisodeParameters,
    RandomizationCfg,
    sample_delay,
    sample_parameters,
)
from pixel2catch.mdp.shaking import Shake, sample_shake
from pixel2catch.mdp.sight import Sight, is_sight_exact, sample_sight
from pixel2catch.mdp.throws import Throw, drawn, sample_throws
from pixel2catch.scene.objects import OBJECTS
from pixel2catch.scene.scene import SceneCfg


@dataclass(frozen=True, kw_only=True)
class Episode:
    """The present episode of each environment."""

    parameters: EpisodeParameters  #: Object, dynamics, biases and latency.
    throw: Throw  #: The throw, in the frame of the robot's base.
    sight: Sight | None  #: What is wrong with the sight; none if nothing ever is.
    shake: Shake | None  #: How the table shakes; none if it stands still.
    #: Control steps between a command and its effect; not always whole.
    command_delay: Float[Tensor, " num_envs"]
    #: Deceleration of the object by air over the square of its speed [1/m]; none without air.
    drag: Float[Tensor, " num_envs"] | None
    record: EpisodeRecord  #: What became of the episode so far.


def draw_episode(
    cfg: CatchEnvCfg,
    action_bias: Float[Tensor, " num_joints"],
    object_ids: Int[Tensor, " num_objects"],
    num_envs: int,
    generator: torch.Generator,
) -> Episode:
    """Draw an episode for every environment, on the generator's device.

    Each is of one of the task's variants, or of none, by their shares.
    """
    episode = _draw(cfg, cfg, action_bias, object_ids, num_envs, generator)
    if not cfg.variants:
        return episode
    chance = torch.rand(num_envs, generator=generator, device=generator.device)
    for variant in cfg.variants:
        other = _draw(variant.of(cfg), cfg, action_bias, object_ids, num_envs, generator)
        episode = select((chance >= 0.0) & (chance < variant.share), other, episode)
        chance = chance - variant.share
    return episode


def _draw(
    cfg: CatchEnvCfg,
    task: CatchEnvCfg,
    action_bias: Float[Tensor, " num_joints"],
    object_ids: Int[Tensor, " num_objects"],
    num_envs: int,
    generator: torch.Generator,
) -> Episode:
    """Draw from one set of ranges.

    What not every task disturbs is drawn last, so that a seed throws the same with and without it.

    Args:
        cfg: The ranges.
        task: The whole task, whose variants decide what an episode holds.
        action_bias: Standard deviation of the error of each action that lasts an episode.
        object_ids: What is thrown.
        num_envs: Number of episodes.
        generator: Where they are drawn from.
    """
    randomization = cfg.randomization
    parameters = sample_parameters(randomization, cfg.sensing, action_bias, object_ids, num_envs, generator)
    drag = None
    if any(each.randomization.air_density for each in task.all_variants):
        density = drawn(randomization.air_density, num_envs, generator)
        by_object = constant(_drag_by_object(cfg.scene), generator.device)
        drag = density * by_object[parameters.object_id] / parameters.mass_scale
    throw = sample_throws(cfg.throws, num_envs, generator, drag)
    is_exact = all(is_sight_exact(each.sensing) for each in task.all_variants)
    sight = None if is_exact else sample_sight(cfg.sensing, throw, generator)
    shake = sample_shake(cfg.shake, num_envs, generator)
    return Episode(
        parameters=parameters,
        throw=throw if shake is None else shake.seen_from_base(throw),
        sight=sight,
        shake=shake,
        command_delay=_command_delay(randomization, num_envs, generator),
        drag=drag,
        record=EpisodeRecord.start(parameters.object_id, throw.aim),
    )


def _command_delay(
    cfg: RandomizationCfg, num_envs: int, generator: torch.Generator
) -> Float[Tensor, " num_envs"]:
    """Nothing is drawn where all episodes have the same, so that a seed goes on as without a delay."""
    first, last = cfg.command_delay
    if first == last:
        return torch.full((num_envs,), float(first), device=generator.device)
    return sample_delay(cfg.command_delay, cfg.command_delay_grid, num_envs, generator)


@cache
def _drag_by_object(scene: SceneCfg) -> tuple[float, ...]:
    """Of every object at its own mass in air of 1 kg/m³ [1/m], in the order of the object table."""
    thrown = [spec.scaled(scene.object_scale) for spec in OBJECTS.values()]
    return tuple(0.5 * spec.drag_area / spec.mass for spec in thrown)
