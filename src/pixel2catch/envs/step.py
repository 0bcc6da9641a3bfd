"""What the environment returns."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.envs.episodes import EpisodeRecord
from pixel2catch.envs.physics_log import PhysicsLog
from pixel2catch.mdp.snapshot import Measurement


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What the networks see."""

    policy: dict[str, Float[Tensor, "num_envs _"]]  #: Observation of each agent, by name.
    #: Input of every value network: all observations and what only the simulator knows.
    state: Float[Tensor, "num_envs _"]
    #: Observation of each agent of another method that is imitated; empty without one.
    teacher: dict[str, Float[Tensor, "num_envs _"]]


@dataclass(frozen=True, kw_only=True)
class Step:
    """What one control step returned; environments that ended have begun anew."""

    observation: Observation  #: What the networks see next.
    rewards: dict[str, Float[Tensor, " num_envs"]]  #: Reward of each agent, by name.
    terminated: Bool[Tensor, " num_envs"]  #: Whether the episode ended, time-outs included (paper).
    truncated: Bool[Tensor, " num_envs"]  #: Never: a time-out is a termination.
    record: EpisodeRecord  #: The episodes up to this step, before any reset.
    log: PhysicsLog  #: What happened within this step, likewise.
    measurement: Measurement  #: What the robot measured, of which `observation` was made.
    joint_pos_target: Float[Tensor, "num_envs num_joints"]  #: The joint targets that were commanded [rad].
