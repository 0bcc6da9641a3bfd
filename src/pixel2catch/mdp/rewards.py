"""Reward terms: pure functions of a transition. Sign and size are in the agent's weights.

Source: paper, Eq. 2-4, unless a term has another source.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.batches import Features, Flags, Scalars
from pixel2catch.checks import NAMED, require_valid
from pixel2catch.mdp import terminations
from pixel2catch.mdp.control_step import Privileged, Transition
from pixel2catch.mdp.terminations import SURFACE_REACH, is_near, needs_all

FINGER_SHARE = 0.6  #: Share of its limit above which a finger's torque costs in a hold (ours, small motors).
ARM_SHARE = 0.9  #: Share of its limit above which the torque of an arm joint costs. Source: ours.

SETTLE_STEPS = 6  #: Control steps in which robot and held object may come to rest. Source: ours; release: 5.


@dataclass(frozen=True, kw_only=True)
class RewardTerm:
    """A weighted term of the reward of a body part."""

    function: Annotated[Callable[..., Scalars], NAMED]  #: (transition, part) -> (num_envs,).
    weight: float  #: Factor, with the sign.
    __post_init__ = require_valid

    @property
    def name(self) -> str:
        """Return the function's name, used in logs and errors."""
        return self.function.__name__


@dataclass(frozen=True, kw_only=True)
class BodyPart:
    """A joint group, its palms and its reward."""

    name: str  #: Name of the group.
    joints: slice  #: Columns of the group's joints, in arrays of all joints.
    palms: slice  #: The palms of its robot.
    fingertips: slice  #: The tips of their fingers.
    touching: slice  #: Its palms and fingers in `Privileged.is_touching`.
    reward: tuple[RewardTerm, ...] = ()  #: Weighted reward terms.

    def reward_terms(self, transition: Transition) -> Features:
        """Return the weighted values of its reward terms, one column each; their sum is the reward."""
        return torch.stack([term.weight * term.function(transition, self) for term in self.reward], dim=-1)

    def with_weights(self, weights: Mapping[str, float]) -> "BodyPart":
        """Return the part with other weights, by names such as `arm.success`."""
        terms = (replace(t, weight=weights.get(f"{self.name}.{t.name}", t.weight)) for t in self.reward)
        return replace(self, reward=tuple(terms))


def elapsed_time(transition: Transition, part: BodyPart) -> Scalars:
    """Return one in every control step. Source: paper, r_time."""
    return torch.ones_like(transition.now.object_pos[:, 0])


def palm_approach(transition: Transition, part: BodyPart) -> Scalars:
    """Return the sum over the palms of d(t-1) - d(t) to the object [m]. Source: paper, Eq. 2.

    Ours: of several robots only the nearest counts; see `_lying_distance` for objects that need all palms.
    """
    closer = _lying_distance(transition.before) - _lying_distance(transition.now)
    return torch.where(_is_nearest_or_needed(transition, part), closer[:, part.palms].sum(dim=-1), 0.0)


def fingertips_approach(transition: Transition, part: BodyPart) -> Scalars:
    """Return the sum over the fingertips of d(t-1) - d(t) to the object [m]. Source: paper, Eq. 2, 4."""
    closer = _fingertip_distance(transition.before) - _fingertip_distance(transition.now)
    return torch.where(_is_nearest_or_needed(transition, part), closer[:, part.fingertips].sum(dim=-1), 0.0)


def success(transition: Transition, part: BodyPart) -> Scalars:
    """Return one at the step that completes the first hold of an episode. Source: paper, succ.

    Ours: for an object that needs all palms, the share of the palms that have reached it.
    """
    return (transition.rested_steps == 1) * terminations.palm_share(transition.now)


def nearness(transition: Transition, part: BodyPart) -> Scalars:
    """Return one while the object is in a palm's reach, or the same share. Source: paper, app."""
    return is_near(transition.now) * terminations.palm_share(transition.now)


def drop(transition: Transition, part: BodyPart) -> Scalars:
    """Return one when the object is lost. Source: paper, drop."""
    return terminations.is_dropped(transition.now).float()


def table_contact(transition: Transition, part: BodyPart) -> Scalars:
    """Return one while the robot touches the table. Source: paper, coll."""
    return transition.now.is_robot_on_table.float()


def robot_contact(transition: Transition, part: BodyPart) -> Scalars:
    """Return one while robots touch each other. Source: ours."""
    return transition.now.is_robot_contact.float()


def table_intrusion(transition: Transition, part: BodyPart) -> Scalars:
    """Return the depth of arm and hand in the table's clearance at the joint targets [m].

    Source: ours: the servo keeps this clearance and delays such commands.
    """
    return transition.geometry.depth_in_table(transition.joint_pos_target)[:, part.palms].sum(dim=-1)


def action_square(transition: Transition, part: BodyPart) -> Scalars:
    """Return the squared norm of the agent's action. Source: paper, Eq. 3 and 4."""
    return transition.action[:, part.joints].square().sum(dim=-1)


def grasp(transition: Transition, part: BodyPart) -> Scalars:
    """Return one while at least two parts of the hand touch the object. Source: ours."""
    return (transition.now.is_touching[:, part.touching].sum(dim=-1) >= 2).float()


def unrest(transition: Transition, part: BodyPart) -> Scalars:
    """Return the sum of squared joint speeds of the agent after `SETTLE_STEPS` of a hold [rad²/s²].

    Source: ours; the release multiplies the weight of the actions by 50 instead.
    """
    speed = transition.now.joint_vel[:, part.joints].square().sum(dim=-1)
    return torch.where(transition.held_steps >= SETTLE_STEPS, speed, 0.0)


def self_contact(transition: Transition, part: BodyPart) -> Scalars:
    """Return one while the robot touches itself. Source: ours, against wear of the finger tips."""
    return transition.now.is_self_contact.float()


def holding_torque(transition: Transition, part: BodyPart) -> Scalars:
    """Return the sum over the joints of torque above `FINGER_SHARE` of its limit, as shares of it.

    It counts while the object is in reach. Source: ours.
    """
    return torch.where(transition.held_steps > 0, _torque_above(FINGER_SHARE, transition, part), 0.0)


def limit_torque(transition: Transition, part: BodyPart) -> Scalars:
    """Return the sum over the joints of torque above `ARM_SHARE` of its limit, as shares of it.

    Source: ours: an arm at its torque limit no longer follows its commands.
    """
    return _torque_above(ARM_SHARE, transition, part)


def _torque_above(share: float, transition: Transition, part: BodyPart) -> Scalars:
    return (transition.now.torque_share[:, part.joints] - share).clamp(min=0.0).sum(dim=-1)


def _is_nearest_or_needed(transition: Transition, part: BodyPart) -> Flags:
    """Return whether the part has the palm nearest to the object, or the object needs all palms (ours)."""
    distance = terminations.palm_distance(transition.before)
    is_nearest = distance[:, part.palms].amin(dim=-1) <= distance.amin(dim=-1)
    return is_nearest | needs_all(transition.before)


def _lying_distance(snapshot: Privileged) -> Float[Tensor, "num_envs num_palms"]:
    """Return distances of the object from each palm, or from a radius above it if it needs all [m]."""
    radius = torch.where(needs_all(snapshot), snapshot.object_reach - SURFACE_REACH, 0.0)
    lying = snapshot.palm_pos + radius[:, None, None] * snapshot.palm_normal
    return torch.linalg.vector_norm(snapshot.object_pos[:, None] - lying, dim=-1)


def _fingertip_distance(snapshot: Privileged) -> Float[Tensor, "num_envs num_fingers"]:
    return torch.linalg.vector_norm(snapshot.object_pos[:, None] - snapshot.fingertip_pos, dim=-1)
