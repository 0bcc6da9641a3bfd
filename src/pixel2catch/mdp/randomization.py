"""What differs from episode to episode: the object, the dynamics, biases and the latency of the camera.

Source: paper, Table I; release (object friction, biases).
"""

from dataclasses import dataclass, field
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.errors import InvalidValueError
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.throws import Amount, Range, uniform
from pixel2catch.robot.constants import ARM_JOINTS, HAND_JOINTS, JOINTS

TABLE_1_GAINS: tuple[Range, ...] = ((0.8, 1.2),) * len(ARM_JOINTS) + ((0.7, 1.3),) * len(HAND_JOINTS)
"""Ranges of the factors on every joint's stiffness and damping. Source: paper, Table I."""


@dataclass(frozen=True, kw_only=True)
class GainRanges:
    """Ranges of the factors on the gains of every joint, in joint order.

    Attributes:
        stiffness_scale: Factor on a joint's stiffness.
        damping_scale: Factor on its damping, drawn apart.
        is_damping_relative: Whether the damping is multiplied by the factor on the stiffness as well, where
            their ratio is better known than either.
    """

    stiffness_scale: tuple[Range, ...] = TABLE_1_GAINS
    damping_scale: tuple[Range, ...] = TABLE_1_GAINS
    is_damping_relative: tuple[bool, ...] = (False,) * len(JOINTS)

    def __post_init__(self) -> None:
        """Refuse ranges that are not of all joints, or of no positive factor."""
        for name in ("stiffness_scale", "damping_scale", "is_damping_relative"):
            length = len(getattr(self, name))
            if length != len(JOINTS):
                raise InvalidValueError(
                    f"{name} has {length} entries; it needs one for each of {len(JOINTS)}"
                )
        for name in ("stiffness_scale", "damping_scale"):
            for joint, (low, high) in zip(JOINTS, getattr(self, name), strict=True):
                if not 0.0 < low <= high < float("inf"):
                    raise InvalidValueError(
                        f"{name} of {joint.name} is from {low:g} to {high:g}; give two factors, the lower "
                        "first, more than 0"
                    )


@dataclass(frozen=True, kw_only=True)
class RandomizationCfg:
    """Ranges of uniform draws and standard deviations of Gaussian ones.

    Attributes:
        gains: Factors on stiffness and damping of each joint.
        arm_action_noise: Standard deviation of the noise on each arm action.
        hand_action_noise: Likewise of the hand.
        arm_action_bias: Standard deviation of an error of each arm action that lasts an episode (release).
        hand_action_bias: Likewise of the hand (release).
        initial_joint_noise: Largest deviation of each joint from its start position [rad].
        mass_scale: Factor on the object's mass and inertia.
        restitution: Restitution of contacts with the object.
        friction: Sliding friction of contacts with the object (release).
        command_delay: Control steps between a command and its effect, first and last of the draw per episode
            (ours; the paper's training has none).
        command_delay_grid: Difference of neighbouring delays that are drawn [control steps]; 0 draws any.
        air_density: Density of the air that slows the object [kg/m³]; 0 is none, as in the paper's training,
            1.2 is real.
    """

    gains: GainRanges = field(default_factory=GainRanges)
    arm_action_noise: float = 0.03
    hand_action_noise: float = 0.02
    arm_action_bias: float = 0.01
    hand_action_bias: float = 0.005
    initial_joint_noise: float = 0.125
    mass_scale: Range = (0.5, 1.5)
    restitution: Range = (0.0, 0.5)
    friction: Range = (0.5, 1.5)
    command_delay: Range = (0, 0)
    command_delay_grid: float = 1.0
    air_density: Amount = 0.0


@dataclass(frozen=True, kw_only=True)
class EpisodeParameters:
    """The draws of one episode in each environment.

    Attributes:
        object_id: Row of the object in the table of objects.
        stiffness_scale: Factor on each joint's stiffness.
        damping_scale: Factor on each joint's damping.
        action_bias: Error of each action.
        joint_bias: Error of each encoder [rad].
        joint_offset: Deviation of each joint from its start position [rad].
        mass_scale: Factor on the object's mass.
        restitution: Restitution of contacts with the object.
        friction: Sliding friction of contacts with the object.
        latency: Control steps between image and delivered box; not always whole.
    """

    object_id: Int[Tensor, " num_envs"]
    stiffness_scale: Float[Tensor, "num_envs num_joints"]
    damping_scale: Float[Tensor, "num_envs num_joints"]
    action_bias: Float[Tensor, "num_envs num_joints"]
    joint_bias: Float[Tensor, "num_envs num_joints"]
    joint_offset: Float[Tensor, "num_envs num_joints"]
    mass_scale: Float[Tensor, " num_envs"]
    restitution: Float[Tensor, " num_envs"]
    friction: Float[Tensor, " num_envs"]
    latency: Float[Tensor, " num_envs"]


def sample_parameters(
    cfg: RandomizationCfg, sensing: SensingCfg, object_ids: Int[Tensor, " num_objects"], num_envs: int,
    generator: torch.Generator,
) -> EpisodeParameters:  # fmt: skip
    """Draw the parameters of one episode per environment, on the generator's device."""
    device = generator.device
    offset = ((-cfg.initial_joint_noise, cfg.initial_joint_noise),) * len(JOINTS)
    scalars = uniform((cfg.mass_scale, cfg.restitution, cfg.friction), num_envs, generator)

    def normal() -> Tensor:
        return torch.randn(num_envs, len(JOINTS), generator=generator, device=device)

    object_id = object_ids[torch.randint(len(object_ids), (num_envs,), generator=generator, device=device)]
    stiffness_scale, damping_scale = _sample_gains(cfg.gains, num_envs, generator)
    return EpisodeParameters(
        object_id=object_id,
        stiffness_scale=stiffness_scale,
        damping_scale=damping_scale,
        action_bias=normal() * by_joint(cfg.arm_action_bias, cfg.hand_action_bias, device),
        joint_bias=normal() * sensing.joint_bias,
        joint_offset=uniform(offset, num_envs, generator),
        mass_scale=scalars[:, 0],
        restitution=scalars[:, 1],
        friction=scalars[:, 2],
        latency=sample_delay(sensing.latency_steps, sensing.latency_grid, num_envs, generator),
    )


def _sample_gains(
    ranges: GainRanges, num_envs: int, generator: torch.Generator
) -> tuple[Float[Tensor, "num_envs num_joints"], Float[Tensor, "num_envs num_joints"]]:
    """Factors on stiffness and damping."""
    stiffness = uniform(ranges.stiffness_scale, num_envs, generator)
    damping = uniform(ranges.damping_scale, num_envs, generator)
    is_relative = _flags(ranges.is_damping_relative, generator.device)
    return stiffness, damping * torch.where(is_relative, stiffness, 1.0)


@lru_cache(maxsize=8)
def _flags(values: tuple[bool, ...], device: torch.device) -> Bool[Tensor, " num_joints"]:
    """Flags on a device, copied only once."""
    return torch.tensor(values, device=device)


def sample_delay(
    limits: Range, grid: float, num_envs: int, generator: torch.Generator
) -> Float[Tensor, " num_envs"]:
    """Draw a delay for every episode, on the generator's device [control steps].

    Args:
        limits: First and last, both included.
        grid: Difference of neighbouring delays, all of which are as likely; 0 draws any.
        num_envs: Number of episodes.
        generator: Where they are drawn from.
    """
    if not grid:
        return uniform((limits,), num_envs, generator)[:, 0]
    first, last = limits
    count = int((last - first) / grid + 1e-6) + 1
    return first + grid * torch.randint(count, (num_envs,), generator=generator, device=generator.device)


@lru_cache(maxsize=8)
def by_joint(arm: float, hand: float, device: torch.device) -> Float[Tensor, " num_joints"]:
    """One value for every arm joint and one for every hand joint, in joint order; copied only once."""
    return torch.cat((torch.full((len(ARM_JOINTS),), arm), torch.full((len(HAND_JOINTS),), hand))).to(device)
