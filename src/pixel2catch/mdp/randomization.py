"""What is drawn for each episode: the object, the dynamics, biases and the latency of the camera.

Source: paper, Table I; release (object friction, biases).
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pixel2catch.batches import Counts, Joints, Scalars
from pixel2catch.checks import Amount, Range, Within
from pixel2catch.devices import constant, uniform
from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.dynamics_file import GainRanges
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.throws import drawn
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.cfg import PUSH_OUT


@dataclass(frozen=True, kw_only=True)
class RandomizationCfg:
    """Ranges of uniform draws and standard deviations of Gaussian ones."""

    gains: GainRanges = field(default_factory=GainRanges)  #: Factors on stiffness and damping of each joint.
    #: Factor on the noise of the actions of each joint group.
    action_noise: Annotated[float, Within(0.0, 50.0)] = 1.0
    action_bias: Annotated[float, Within(0.0, 50.0)] = 1.0  #: Factor on their bias in an episode.
    #: Largest deviation of each joint from its start position [rad].
    initial_joint_noise: Annotated[float, Within(0.0, 1.0)] = 0.125
    #: Factor on the object's mass and inertia.
    mass_scale: Annotated[Range, Within(0.01, 100.0)] = (0.5, 1.5)
    restitution: Annotated[Range, Within(0.0, 1.0)] = (0.0, 0.5)  #: Restitution of contacts with the object.
    #: Sliding friction of contacts with the object (release).
    friction: Annotated[Range, Within(0.0, 5.0)] = (0.5, 1.5)
    #: Share of a penetration of the object that a physics step removes: stiffness of contacts (ours).
    push_out: Annotated[Amount, Within(0.01, 1.0)] = PUSH_OUT
    #: Control steps between a command and its effect, drawn for each episode (ours; paper: none).
    command_delay: Annotated[Range, Within(0.0, 30.0)] = (0, 0)
    #: Difference of neighbouring delays [control steps]; 0 draws any.
    command_delay_grid: Annotated[float, Within(0.0, 30.0)] = 1.0
    #: Sideways acceleration by the air over the square of the speed [1/m], of random sign; paper: 0.
    side_force: Annotated[Amount, Within(0.0, 1.0)] = 0.0
    #: Density of the air that slows the object [kg/m³]; paper: 0, at sea level: 1.2.
    air_density: Annotated[Amount, Within(0.0, 10.0)] = 0.0


@dataclass(frozen=True, kw_only=True)
class EpisodeParameters:
    """The draws of one episode in each environment."""

    object_id: Counts  #: Row of the object in the table of objects.
    stiffness_scale: Joints  #: Factor on each joint's stiffness.
    damping_scale: Joints  #: Factor on each joint's damping.
    action_bias: Joints  #: Error of each action.
    joint_bias: Joints  #: Error of each encoder [rad].
    joint_offset: Joints  #: Deviation of each joint from its start position [rad].
    mass_scale: Scalars  #: Factor on the object's mass.
    restitution: Scalars  #: Restitution of contacts with the object.
    friction: Scalars  #: Sliding friction of contacts with the object.
    push_out: Scalars  #: Share of its penetration that a physics step removes.
    latency: Scalars  #: Control steps between image and delivered box; not always whole.


def sample_parameters(
    cfg: RandomizationCfg,
    sensing: SensingCfg,
    action_bias: Float[Tensor, " num_joints"],
    object_ids: Int[Tensor, " num_objects"],
    num_envs: int,
    generator: torch.Generator,
) -> EpisodeParameters:
    """Draw the parameters of one episode per environment, on the generator's device.

    The gains of `cfg` have an entry for each joint; `action_bias` is the standard deviation of the bias of
    each action.
    """
    device, num_joints = generator.device, len(action_bias)
    offset = ((-cfg.initial_joint_noise, cfg.initial_joint_noise),) * num_joints
    scalars = uniform((cfg.mass_scale, cfg.restitution, cfg.friction), num_envs, generator)
    normal = partial(torch.randn, num_envs, num_joints, generator=generator, device=device)
    object_id = object_ids[torch.randint(len(object_ids), (num_envs,), generator=generator, device=device)]
    stiffness_scale = uniform(cfg.gains.stiffness_scale, num_envs, generator)
    damping_scale = uniform(cfg.gains.damping_scale, num_envs, generator)
    is_relative = constant(cfg.gains.is_damping_relative, device, torch.bool)
    return EpisodeParameters(
        object_id=object_id,
        stiffness_scale=stiffness_scale,
        damping_scale=damping_scale * torch.where(is_relative, stiffness_scale, 1.0),
        action_bias=normal() * (cfg.action_bias * action_bias),
        joint_bias=normal() * sensing.joint_bias,
        joint_offset=uniform(offset, num_envs, generator),
        mass_scale=scalars[:, 0],
        restitution=scalars[:, 1],
        friction=scalars[:, 2],
        push_out=drawn(cfg.push_out, num_envs, generator),
        latency=sample_delay(sensing.latency_steps, sensing.latency_grid, num_envs, generator),
    )


def sample_delay(limits: Range, grid: float, num_envs: int, generator: torch.Generator) -> Scalars:
    """Draw a delay for every episode, on the generator's device [control steps].

    Delays from the first limit to the last, `grid` apart, are equally likely; a grid of 0 draws any.
    """
    if not grid:
        return uniform((limits,), num_envs, generator)[:, 0]
    first, last = limits
    count = int((last - first) / grid + 1e-6) + 1
    if last - first - grid * (count - 1) > 1e-6:
        raise InvalidValueError(f"delays {first:g} to {last:g} do not fit their grid, {grid:g}; 0 draws any.")
    return first + grid * torch.randint(count, (num_envs,), generator=generator, device=generator.device)


def by_joint(workcell: WorkcellSpec, name: str, device: torch.device) -> Float[Tensor, " num_joints"]:
    """Return a number of the joint groups for each of their joints, in joint order."""
    values = [getattr(group, name) for group in workcell.groups for _ in group.joints]
    return torch.tensor(values, dtype=torch.float32, device=device)
