"""What an environment remembers from one control step to the next."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from pixel2catch.mdp.delay import DelayLine
from pixel2catch.mdp.sensing import Detection
from pixel2catch.mdp.snapshot import History, Privileged


@dataclass(frozen=True, kw_only=True)
class Command:
    """What was last commanded."""

    action: Float[Tensor, "num_envs num_joints"]
    joint_pos_target: Float[Tensor, "num_envs num_joints"]


@dataclass(frozen=True, kw_only=True)
class Senses:
    """What was seen and measured up to now."""

    image: Detection
    detections: DelayLine[Detection]
    history: History
    before: Privileged
    now: Privileged
