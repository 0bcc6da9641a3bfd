"""Observation terms: pure functions of a frame. The robot in the laboratory runs these very functions.

An agent's observation is its terms on two consecutive frames, oldest first (paper, Sec. IV-C).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.camera.features import PIXEL_FEATURES, pixel_features
from pixel2catch.mdp.snapshot import History, Measurement, Privileged
from pixel2catch.robot.constants import RGB_CAMERA


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One control step as an agent sees it.

    Attributes:
        before: The measurement one control step earlier.
        now: The measurement.
        joints: The agent's columns in joint order.
        pixel_columns: The columns of `PIXEL_FEATURES` that the method uses.
    """

    before: Measurement
    now: Measurement
    joints: slice
    pixel_columns: tuple[int, ...]


ObservationTerm = Callable[[Frame], Float[Tensor, "num_envs k"]]


def pixels(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The method's pixel features z. Source: paper, Eq. 1."""
    features = pixel_features(frame.before.box, frame.now.box, RGB_CAMERA)
    return torch.stack([features[:, column] for column in frame.pixel_columns], dim=-1)


def object_position(frame: Frame) -> Float[Tensor, "num_envs 6"]:
    """Position of the object and its change since the step before, world frame [m]. Source: ours (oracle)."""
    return torch.cat((frame.now.object_pos, frame.now.object_pos - frame.before.object_pos), dim=-1)


def initial_object_position(frame: Frame) -> Float[Tensor, "num_envs 3"]:
    """Where the object was when the episode began, world frame [m]. Source: paper, Sec. V-A (w/o-PF)."""
    return frame.now.initial_object_pos


def palm_pose(frame: Frame) -> Float[Tensor, "num_envs 7"]:
    """Palm position [m] and orientation (w, x, y, z), world frame. Source: paper, Sec. IV-C."""
    return torch.cat((frame.now.palm_pos, frame.now.palm_quat), dim=-1)


def joint_pos(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The agent's joint positions [rad]. Source: paper, Sec. IV-C."""
    return frame.now.joint_pos[:, frame.joints]


def last_action(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The agent's last action. Source: paper, Sec. IV-C."""
    return frame.now.action[:, frame.joints]


def palm_displacement(frame: Frame) -> Float[Tensor, "num_envs 3"]:
    """Movement of the palm since the step before [m]. Source: release (where it is always zero by a slip)."""
    return frame.now.palm_pos - frame.before.palm_pos


def joint_pos_target(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The agent's joint targets [rad]. Source: release."""
    return frame.now.joint_pos_target[:, frame.joints]


PROPRIOCEPTION: tuple[ObservationTerm, ...] = (palm_pose, joint_pos, last_action)
PAPER_TERMS: tuple[ObservationTerm, ...] = (pixels, *PROPRIOCEPTION)
JOURNAL_TERMS: tuple[ObservationTerm, ...] = (*PAPER_TERMS, palm_displacement, joint_pos_target)


def pixel_columns(names: tuple[str, ...]) -> tuple[int, ...]:
    """Columns of named pixel features."""
    return tuple(PIXEL_FEATURES.index(name) for name in names)


def observe(
    terms: tuple[ObservationTerm, ...], joints: slice, columns: tuple[int, ...], history: History
) -> Float[Tensor, "num_envs size"]:
    """An agent's observation: its terms on both frames of the history, oldest first."""
    frames = (
        Frame(before=history.oldest, now=history.before, joints=joints, pixel_columns=columns),
        Frame(before=history.before, now=history.now, joints=joints, pixel_columns=columns),
    )
    return torch.cat([term(frame) for frame in frames for term in terms], dim=-1)


def privileged_state(before: Privileged, now: Privileged) -> Float[Tensor, "num_envs 21"]:
    """What the value networks see besides the observations.

    Source: paper (object position, two frames); release (object displacement, object - palm).
    """
    return torch.cat(
        (
            before.object_pos,
            now.object_pos,
            now.object_pos - before.object_pos,
            now.object_pos - now.palm_pos,
            now.object_lin_vel,
            now.is_touching.float(),
            now.is_robot_on_table.float()[:, None],
        ),
        dim=-1,
    )
