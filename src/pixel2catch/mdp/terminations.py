"""When the object is reached, held or lost, and when an episode ends."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.batches import Flags, Scalars
from pixel2catch.checks import Within
from pixel2catch.mdp.control_step import Privileged, Transition

REACH = 0.08  #: Distance of palm and object under which the object counts as reached [m]. Source: release.
ONE_HAND_RADIUS = 0.07
"""Mean radius of an object above which all palms are needed [m]. Source: ours (experiments/LOG.md)."""
SURFACE_REACH = 0.035
"""Distance of palm and surface under which a larger object, taken as a ball, counts as reached [m].

Source: ours, the least that `REACH` leaves at the release's objects.
"""
HOLD_STEPS = 20  #: Consecutive control steps in reach that make a success. Source: release.
DROP_HEIGHT = 0.45  #: Height under which the object is lost [m]. Source: release.
DROP_X = 0.03  #: World x under which the object has passed the robot [m]. Source: release.


@dataclass(frozen=True, kw_only=True)
class EpisodeCfg:
    """When an episode ends, besides by the loss of the object."""

    #: Control steps after which it ends: 3.0 s (Source: release).
    max_steps: Annotated[int, Within(1, 100_000)] = 90
    #: Control steps from a success to the end of the episode (Source: release, 0; ours: hold test).
    rest_steps: Annotated[int, Within(0, 100_000)] = 0
    #: Whether contact of two robots ends it, as in evaluation (ours); in training it costs a reward instead.
    ends_on_robot_contact: bool = False


def palm_distance(snapshot: Privileged) -> Float[Tensor, "num_envs num_palms"]:
    """Return the distance d of each palm and the object's centre [m]. Source: paper, Eq. 2."""
    return torch.linalg.vector_norm(snapshot.object_pos[:, None] - snapshot.palm_pos, dim=-1)


def reach_of(radius: float) -> float:
    """Return the distance from a palm under which an object of this mean radius counts as reached [m]."""
    return max(REACH, radius + SURFACE_REACH)


def near_palms(snapshot: Privileged) -> Bool[Tensor, "num_envs num_palms"]:
    """Return which palms have reached the object. Source: release, d < 0.08 m."""
    return palm_distance(snapshot) < snapshot.object_reach[:, None]


def needs_all(snapshot: Privileged) -> Flags:
    """Return whether there are several palms and the object needs all of them."""
    has_several = snapshot.palm_pos.shape[1] > 1
    return (snapshot.object_reach > reach_of(ONE_HAND_RADIUS)) & has_several


def palm_share(snapshot: Privileged) -> Scalars:
    """Return the share of palms that have reached an object that needs all; one for other objects."""
    return torch.where(needs_all(snapshot), near_palms(snapshot).float().mean(dim=-1), 1.0)


def is_near(snapshot: Privileged) -> Flags:
    """Return whether a palm has reached the object: the paper's tracking."""
    return near_palms(snapshot).any(dim=-1)


def is_dropped(snapshot: Privileged) -> Flags:
    """Return whether the object fell or passed the robot. Source: release."""
    return (snapshot.object_pos[:, 2] < DROP_HEIGHT) | (snapshot.object_pos[:, 0] < DROP_X)


def is_lost(snapshot: Privileged) -> Flags:
    """Return whether the object is dropped, or robots touch each other (ours)."""
    return is_dropped(snapshot) | snapshot.is_robot_contact


def is_ended(transition: Transition, cfg: EpisodeCfg) -> Flags:
    """Return whether an episode ends by success, loss or time-out, all terminations. Source: release."""
    lost = is_lost if cfg.ends_on_robot_contact else is_dropped
    ended = lost(transition.now) | (transition.episode_steps >= cfg.max_steps)
    return ended | (transition.rested_steps > cfg.rest_steps)
