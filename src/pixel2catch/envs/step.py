"""What the environment returns."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.envs.episodes import EpisodeRecord
from pixel2catch.envs.physics_log import PhysicsLog
from pixel2catch.mdp.snapshot import Measurement


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What the networks see.

    Attributes:
        policy: Observation of each agent, by name.
        state: Input of every value network: all observations and what only the simulator knows.
        teacher: Observation of each agent of another method that is imitated; empty without one.
    """

    policy: dict[str, Float[Tensor, "num_envs _"]]
    state: Float[Tensor, "num_envs _"]
    teacher: dict[str, Float[Tensor, "num_envs _"]]


@dataclass(frozen=True, kw_only=True)
class Step:
    """What one control step returned; environments that ended have begun anew.

    Attributes:
        observation: What the networks see next.
        rewards: Reward of each agent, by name.
        terminated: Whether the episode ended, time-outs included (paper).
        truncated: Never: a time-out is a termination.
        record: The episodes up to this step, before any reset.
        log: What happened within this step, likewise.
        measurement: What the robot measured, of which `observation` was made.
        joint_pos_target: The joint targets that were commanded [rad].
    """

    observation: Observation
    rewards: dict[str, Float[Tensor, " num_envs"]]
    terminated: Bool[Tensor, " num_envs"]
    truncated: Bool[Tensor, " num_envs"]
    record: EpisodeRecord
    log: PhysicsLog
    measurement: Measurement
    joint_pos_target: Float[Tensor, "num_envs num_joints"]
