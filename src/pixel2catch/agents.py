"""The agents of a work cell, one for each joint group; their sum is the single agent.

Sources: observations paper Sec. IV-C, actions Sec. IV-D, rewards Eq. 3 and 4.
Differs: the hand is also rewarded for a grasp (ours); the paper's success is a distance only.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.checks import NAME
from pixel2catch.mdp import control_step, rewards
from pixel2catch.mdp.control_step import Transition
from pixel2catch.mdp.observations import PAPER_TERMS, ObservationTerm
from pixel2catch.mdp.rewards import BodyPart, RewardTerm
from pixel2catch.robots.spec import JointGroup
from pixel2catch.robots.workcell import WorkcellSpec

ACTION_WEIGHT = -0.01  #: Weight of the squared action of each agent. Source: paper, Eq. 3 and 4.

ARM_REWARD = (
    RewardTerm(function=rewards.elapsed_time, weight=-0.01),
    RewardTerm(function=rewards.palm_approach, weight=1.0),
    RewardTerm(function=rewards.success, weight=10.0),
    RewardTerm(function=rewards.nearness, weight=0.1),
    RewardTerm(function=rewards.drop, weight=-5.0),
    RewardTerm(function=rewards.table_contact, weight=-5.0),
    RewardTerm(function=rewards.action_square, weight=ACTION_WEIGHT),
)
"""Reward of a group that carries a palm. Source: paper, Eq. 3."""

HAND_REWARD = (
    RewardTerm(function=rewards.palm_approach, weight=0.2),
    RewardTerm(function=rewards.fingertips_approach, weight=0.2),
    RewardTerm(function=rewards.grasp, weight=0.2),
    RewardTerm(function=rewards.success, weight=10.0),
    RewardTerm(function=rewards.drop, weight=-5.0),
    RewardTerm(function=rewards.table_contact, weight=-5.0),
    RewardTerm(function=rewards.action_square, weight=ACTION_WEIGHT),
)
"""Reward of a group that moves fingers. Source: paper, Eq. 4."""

BESIDE_OTHERS = RewardTerm(function=rewards.robot_contact, weight=-1.0)
"""Further reward of every group with several robots. Source: ours; ten steps outweigh a success."""

REWARDS = {"arm": ARM_REWARD, "hand": HAND_REWARD}

RESTING_REWARDS = {
    "arm": (
        *ARM_REWARD,
        RewardTerm(function=rewards.unrest, weight=-0.01),
        RewardTerm(function=rewards.table_intrusion, weight=-5.0),
        RewardTerm(function=rewards.limit_torque, weight=0.0),
    ),
    "hand": (
        *HAND_REWARD,
        RewardTerm(function=rewards.self_contact, weight=-0.02),
        RewardTerm(function=rewards.holding_torque, weight=0.0),
    ),
}
"""Rewards by role with costs of moving a held object, aiming into the table, and self-contact.

Source: ours; with larger weights policies do not grasp (experiments/LOG.md). Terms of weight 0 are for
trainings with `--rewards`.
"""


@dataclass(frozen=True, kw_only=True)
class AgentSpec:
    """One learner: its joints, observation and reward."""

    name: Annotated[str, NAME]  #: Name in logs, files and the agents' dictionaries.
    parts: tuple[BodyPart, ...]  #: Its body parts, in joint order; their rewards are added.
    teammates: tuple[BodyPart, ...] = ()  #: Body parts of others whose reward is added.
    observation: tuple[ObservationTerm, ...] = PAPER_TERMS  #: Terms of one observation frame.
    memory: tuple[ObservationTerm, ...] = ()  #: Terms that summarise earlier boxes.

    @cached_property
    def joints(self) -> control_step.Columns:
        """Return the agent's columns in joint order."""
        return control_step.merged([part.joints for part in self.parts])

    @cached_property
    def palms(self) -> control_step.Columns:
        """Return the palms that it serves, each once."""
        served = sorted({palm for part in self.parts for palm in range(part.palms.start, part.palms.stop)})
        return control_step.merged([slice(palm, palm + 1) for palm in served])

    @property
    def num_joints(self) -> int:
        """Return the number of actions."""
        return sum(each.stop - each.start for each in self.joints)

    @property
    def reward_names(self) -> tuple[str, ...]:
        """Return the names of the reward terms, in the order of `reward_terms`."""
        return tuple(f"{part.name}.{term.name}" for part in self._rewarded for term in part.reward)

    def reward_terms(self, transition: Transition) -> Float[Tensor, "num_envs num_terms"]:
        """Return the weighted reward terms of parts and teammates; the reward is their sum."""
        return torch.cat([part.reward_terms(transition) for part in self._rewarded], dim=-1)

    @property
    def _rewarded(self) -> tuple[BodyPart, ...]:
        return tuple(part for part in (*self.parts, *self.teammates) if part.reward)

    def to_dict(self) -> dict[str, Any]:
        """Return names of its observation terms, and weights of its reward terms, ready for JSON."""
        weights = [term.weight for part in self._rewarded for term in part.reward]
        return {
            "observation": [term.__name__ for term in self.observation],
            "memory": [term.__name__ for term in self.memory],
            "rewards": dict(zip(self.reward_names, weights, strict=True)),
        }

    def __add__(self, other: "AgentSpec") -> "AgentSpec":
        """Return one agent over the joints of both, with both rewards. Source: paper, S-A RL."""
        return replace(self, name="robot", parts=(*self.parts, *other.parts))


def agents_of(
    workcell: WorkcellSpec, rewards_by_role: dict[str, tuple[RewardTerm, ...]] = REWARDS
) -> tuple[AgentSpec, ...]:
    """Return one agent for each joint group of a work cell, in joint order."""
    also = (BESIDE_OTHERS,) if len(workcell.robots) > 1 else ()
    return tuple(
        AgentSpec(name=group.name, parts=(_part_of(workcell, group, rewards_by_role[group.role] + also),))
        for group in workcell.groups
    )


def _part_of(workcell: WorkcellSpec, group: JointGroup, reward: tuple[RewardTerm, ...]) -> BodyPart:
    served = [i for i, palm in enumerate(workcell.palms) if group.name in palm.groups]
    fingers = [len(palm.spec.fingers) for palm in workcell.palms]
    first, stop = served[0], served[-1] + 1
    before, after = sum(fingers[:first]), sum(fingers[:stop])
    return BodyPart(
        name=group.name,
        joints=workcell.columns(group.name),
        palms=slice(first, stop),
        fingertips=slice(before, after),
        touching=slice(before + first, after + stop),
        reward=reward,
    )


def together(agents: tuple[AgentSpec, ...]) -> AgentSpec:
    """Return one agent in place of several."""
    first, *others = agents
    return sum(others, start=first)


def agents_by_robot(workcell: WorkcellSpec, agents: tuple[AgentSpec, ...]) -> tuple[AgentSpec, ...]:
    """Return one agent for each robot of a work cell, in place of those of its joint groups."""
    robots = []
    for placed in workcell.robots:
        own = {placed.prefix + group.name for part in placed.robot.parts for group in part.groups}
        robot = together(tuple(agent for agent in agents if agent.name in own))
        robots.append(replace(robot, name=f"{placed.prefix}robot"))
    return tuple(robots)


def sharing(agents: tuple[AgentSpec, ...]) -> tuple[AgentSpec, ...]:
    """Return the agents, each with the sum of all rewards."""
    return tuple(
        replace(agent, teammates=tuple(part for mate in agents if mate is not agent for part in mate.parts))
        for agent in agents
    )


def commands_of(workcell: WorkcellSpec) -> tuple[control_step.JointCommand, ...]:
    """Return how the action of each joint becomes its target. Source: paper, Sec. IV-D."""
    laws = {"relative": control_step.relative_command, "absolute": control_step.absolute_command}
    return tuple(laws[group.command](joint) for group in workcell.groups for joint in group.joints)
