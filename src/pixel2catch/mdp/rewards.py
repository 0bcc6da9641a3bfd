"""Reward terms: pure functions of a transition. The sign and size of each is in its agent's weight.

Source: paper, Eq. 2-4, unless a term says otherwise.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.mdp.snapshot import Privileged, Transition
from pixel2catch.mdp.terminations import (
    SURFACE_REACH,
    is_dropped,
    is_near,
    is_success,
    needs_all,
    palm_distance,
    palm_share,
)

SETTLE_STEPS = 6
"""Control steps that a held object may take to come to rest, with the robot. Source: ours; release: 5."""


@dataclass(frozen=True, kw_only=True)
class RewardTerm:
    """A weighted term of the reward of a body part."""

    function: Callable[..., Float[Tensor, " num_envs"]]  #: (transition, part) -> (num_envs,).
    weight: float  #: Factor, with the sign.

    @property
    def name(self) -> str:
        """The function's name, used in logs and errors."""
        return self.function.__name__


@dataclass(frozen=True, kw_only=True)
class BodyPart:
    """A joint group with the palms that it serves, and the reward that belongs to it."""

    name: str  #: Name of the group.
    joints: slice  #: Its columns in joint order.
    palms: slice  #: The palms of its robot.
    fingertips: slice  #: The tips of their fingers.
    touching: slice  #: Its palms and fingers in `Privileged.is_touching`.
    reward: tuple[RewardTerm, ...] = ()  #: Weighted reward terms.

    def reward_terms(self, transition: Transition) -> Float[Tensor, "num_envs k"]:
        """Weighted values of its reward terms, one column each; their sum is the reward."""
        return torch.stack([term.weight * term.function(transition, self) for term in self.reward], dim=-1)

    def with_weights(self, weights: Mapping[str, float]) -> "BodyPart":
        """The part with other weights, by names such as `arm.success`."""
        terms = (replace(t, weight=weights.get(f"{self.name}.{t.name}", t.weight)) for t in self.reward)
        return replace(self, reward=tuple(terms))


def elapsed_time(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """One per control step. Source: paper, r_time."""
    return torch.ones_like(transition.now.object_pos[:, 0])


def palm_approach(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """Sum over the palms of d(t-1) - d(t) to the object [m], if its robot is called. Source: paper, Eq. 2.

    Ours: what is too large for one of several robots comes nearer to lying on a palm, not to its middle.
    """
    closer = _lying_distance(transition.before) - _lying_distance(transition.now)
    return torch.where(_is_called(transition, part), closer[:, part.palms].sum(dim=-1), 0.0)


def fingertips_approach(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """Sum over the fingertips of d(t-1) - d(t) to the object [m], likewise. Source: paper, Eq. 2 and 4."""
    closer = _fingertip_distance(transition.before) - _fingertip_distance(transition.now)
    return torch.where(_is_called(transition, part), closer[:, part.fingertips].sum(dim=-1), 0.0)


def success(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """One at the step that completes the first hold of an episode. Source: paper, succ.

    Ours: of what is too large for one of several robots, the share of the palms that have reached it.
    """
    return (is_success(transition) & ~transition.was_success) * palm_share(transition.now)


def nearness(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """One while the object is in a palm's reach. Source: paper, app.

    Ours: of what is too large for one of several robots, the share of the palms that have reached it.
    """
    return is_near(transition.now) * palm_share(transition.now)


def drop(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """One when the object is lost. Source: paper, drop."""
    return is_dropped(transition.now).float()


def table_contact(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """One while the robot touches the table. Source: paper, coll."""
    return transition.now.is_robot_on_table.float()


def robot_contact(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """One while robots touch each other. Source: ours."""
    return transition.now.is_robot_contact.float()


def table_intrusion(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """How deep arm and hand would be in the table's clearance at the joint targets [m].

    Source: ours: a servo that keeps clear of the table holds such commands back, and the hand comes late.
    """
    return transition.geometry.depth_in_table(transition.joint_pos_target)[:, part.palms].sum(dim=-1)


def action_square(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """Squared norm of the agent's action. Source: paper, Eq. 3 and 4."""
    return transition.action[:, part.joints].square().sum(dim=-1)


def grasp(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """One while at least two parts of the hand touch the object. Source: ours, so that a hold is a grasp."""
    return (transition.now.is_touching[:, part.touching].sum(dim=-1) >= 2).float()


def unrest(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """Sum of the squared speeds of the agent's joints once the object has been held a while [rad²/s²].

    Source: ours, so that a robot that holds an object stands still; the release weights actions 50 times
    higher then.
    """
    speed = transition.now.joint_vel[:, part.joints].square().sum(dim=-1)
    return torch.where(transition.held_steps >= SETTLE_STEPS, speed, 0.0)


def self_contact(transition: Transition, part: BodyPart) -> Float[Tensor, " num_envs"]:
    """One while the robot touches itself. Source: ours: finger tips that press on each other wear."""
    return transition.now.is_self_contact.float()


def _is_called(transition: Transition, part: BodyPart) -> Bool[Tensor, " num_envs"]:
    """Whether the part's robot has the palm nearest to the object before the step, or all are needed.

    Source: ours, so that several robots are not all drawn to one place; the paper's only robot always is.
    """
    distance = palm_distance(transition.before)
    is_nearest = distance[:, part.palms].amin(dim=-1) <= distance.amin(dim=-1)
    return is_nearest | needs_all(transition.before)


def _lying_distance(snapshot: Privileged) -> Float[Tensor, "num_envs num_palms"]:
    """Distance of each palm and the object's centre [m].

    Ours: of one that needs all palms, from where its centre is if it lies on the palm, a radius over it, so
    that a palm looks at the object from a side of its own.
    """
    radius = torch.where(needs_all(snapshot), snapshot.object_reach - SURFACE_REACH, 0.0)
    lying = snapshot.palm_pos + radius[:, None, None] * snapshot.palm_normal
    return torch.linalg.vector_norm(snapshot.object_pos[:, None] - lying, dim=-1)


def _fingertip_distance(snapshot: Privileged) -> Float[Tensor, "num_envs num_fingers"]:
    return torch.linalg.vector_norm(snapshot.object_pos[:, None] - snapshot.fingertip_pos, dim=-1)
