"""The two agents, arm and hand, as values of one type; their sum is the single agent.

Sources: observations paper Sec. IV-C, actions Sec. IV-D, rewards Eq. 3 and 4.
Differs: the hand is also rewarded for a grasp (ours); the paper's success is a distance only.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.mdp import rewards
from pixel2catch.mdp.actions import JointCommand, absolute_command, relative_command
from pixel2catch.mdp.observations import PAPER_TERMS, ObservationTerm
from pixel2catch.mdp.rewards import RewardTerm, term_values
from pixel2catch.mdp.snapshot import Transition
from pixel2catch.robot.constants import ARM_JOINTS, HAND_JOINTS, JOINTS

ACTION_WEIGHT = -0.01
"""Weight of the squared action of each agent. Source: paper, Eq. 3 and 4."""


@dataclass(frozen=True, kw_only=True)
class BodyPart:
    """Consecutive joints with the reward that belongs to them.

    Attributes:
        name: Name in logs.
        joints: Their columns in joint order.
        reward: Weighted reward terms.
    """

    name: str
    joints: slice
    reward: tuple[RewardTerm, ...]


@dataclass(frozen=True, kw_only=True)
class AgentSpec:
    """One learner: the joints it moves, what it sees, and what it is rewarded for.

    Attributes:
        name: Name in logs, files and the agents' dictionaries.
        parts: The body parts that it moves, in joint order; its reward is the sum of theirs.
        teammates: Body parts that others move, whose reward it gets as well.
        observation: Terms of one observation frame.
        memory: Terms of what it remembers of the images.
    """

    name: str
    parts: tuple[BodyPart, ...]
    teammates: tuple[BodyPart, ...] = ()
    observation: tuple[ObservationTerm, ...] = PAPER_TERMS
    memory: tuple[ObservationTerm, ...] = ()

    @property
    def joints(self) -> slice:
        """The agent's columns in joint order."""
        return slice(self.parts[0].joints.start, self.parts[-1].joints.stop)

    @property
    def num_joints(self) -> int:
        """Number of actions."""
        return self.joints.stop - self.joints.start

    @property
    def reward_names(self) -> tuple[str, ...]:
        """Names of the reward terms, in the order of `reward_terms`."""
        return tuple(f"{part.name}.{term.name}" for part in self._rewarded for term in part.reward)

    def reward_terms(self, transition: Transition) -> Float[Tensor, "num_envs num_terms"]:
        """Weighted reward terms of its parts and its teammates'; the agent's reward is their sum."""
        values = [term_values(part.reward, part.joints, transition) for part in self._rewarded]
        return torch.cat(values, dim=-1)

    @property
    def _rewarded(self) -> tuple[BodyPart, ...]:
        return (*self.parts, *self.teammates)

    def __add__(self, other: "AgentSpec") -> "AgentSpec":
        """One agent over the joints of both, with the sum of both rewards. Source: paper, S-A RL."""
        return replace(self, name="robot", parts=(*self.parts, *other.parts))


def _paying(agent: AgentSpec, *terms: RewardTerm) -> AgentSpec:
    """The agent with more reward terms for each of its parts."""
    parts = tuple(replace(part, reward=(*part.reward, *terms)) for part in agent.parts)
    return replace(agent, parts=parts)


COMMANDS: tuple[JointCommand, ...] = (*map(relative_command, ARM_JOINTS), *map(absolute_command, HAND_JOINTS))
"""How the action of each joint becomes its target."""

ARM = AgentSpec(
    name="arm",
    parts=(
        BodyPart(
            name="arm",
            joints=slice(0, len(ARM_JOINTS)),
            reward=(
                RewardTerm(function=rewards.elapsed_time, weight=-0.01),
                RewardTerm(function=rewards.palm_approach, weight=1.0),
                RewardTerm(function=rewards.success, weight=10.0),
                RewardTerm(function=rewards.nearness, weight=0.1),
                RewardTerm(function=rewards.drop, weight=-5.0),
                RewardTerm(function=rewards.table_contact, weight=-5.0),
                RewardTerm(function=rewards.action_square, weight=ACTION_WEIGHT),
            ),
        ),
    ),
)

HAND = AgentSpec(
    name="hand",
    parts=(
        BodyPart(
            name="hand",
            joints=slice(len(ARM_JOINTS), len(JOINTS)),
            reward=(
                RewardTerm(function=rewards.palm_approach, weight=0.2),
                RewardTerm(function=rewards.fingertips_approach, weight=0.2),
                RewardTerm(function=rewards.grasp, weight=0.2),
                RewardTerm(function=rewards.success, weight=10.0),
                RewardTerm(function=rewards.drop, weight=-5.0),
                RewardTerm(function=rewards.table_contact, weight=-5.0),
                RewardTerm(function=rewards.action_square, weight=ACTION_WEIGHT),
            ),
        ),
    ),
)


RESTING_ARM = _paying(
    ARM,
    RewardTerm(function=rewards.unrest, weight=-0.01),
    RewardTerm(function=rewards.table_intrusion, weight=-5.0),
)
RESTING_HAND = _paying(HAND, RewardTerm(function=rewards.self_contact, weight=-0.02))
"""Arm and hand that also pay for moving a held object about, for aiming into the table, and for touching
themselves.

Source: ours. Larger weights, and paying for the motion of fingers, keep them from grasping at all
(experiments/LOG.md).
"""
