"""Observation terms: pure functions of a frame. The robot in the laboratory runs these very functions.

An agent's observation is its terms on two consecutive frames, oldest first (paper, Sec. IV-C).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.camera import box_history
from pixel2catch.camera.boxes import PIXEL_FEATURES, pixel_features
from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.device_constants import constant
from pixel2catch.mdp.columns import Columns, take
from pixel2catch.mdp.snapshot import History, Measurement, Privileged
from pixel2catch.scene.constants import RGB_CAMERA


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One control step as an agent sees it."""

    before: Measurement  #: The measurement one control step earlier.
    now: Measurement  #: The measurement.
    joints: Columns  #: The agent's columns in joint order.
    palms: Columns  #: The palms that it serves.
    pixel_columns: tuple[int, ...]  #: The columns of `PIXEL_FEATURES` that the method uses.


ObservationTerm = Callable[[Frame], Float[Tensor, "num_envs k"]]


def pixels(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The method's pixel features z. Source: paper, Eq. 1."""
    features = pixel_features(frame.before.box, frame.now.box, RGB_CAMERA)
    return torch.stack([features[:, column] for column in frame.pixel_columns], dim=-1)


def object_position(frame: Frame) -> Float[Tensor, "num_envs 6"]:
    """Position of the object and its change since the step before, world frame [m]. Source: ours (oracle)."""
    return torch.cat((frame.now.object_pos, frame.now.object_pos - frame.before.object_pos), dim=-1)


def object_extent(frame: Frame) -> Float[Tensor, "num_envs 2"]:
    """Width and height of the box at the object's distance [m]. Source: ours (oracle that knows sizes)."""
    box, place = frame.now.box, frame.now.object_pos[:, None]
    _, depth = nominal_projection(RGB_CAMERA, place).pixels(place)
    focal = constant((RGB_CAMERA.fx, RGB_CAMERA.fy), box.device)
    return (box[:, 2:] - box[:, :2]) * depth / focal


def initial_object_position(frame: Frame) -> Float[Tensor, "num_envs 3"]:
    """Where the object was when the episode began, world frame [m]. Source: paper, Sec. V-A (w/o-PF)."""
    return frame.now.initial_object_pos


def palm_pose(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """Position [m] and orientation (w, x, y, z) of the agent's palms (world). Source: paper, Sec. IV-C."""
    pose = torch.cat((frame.now.palm_pos, frame.now.palm_quat), dim=-1)
    return take(pose, frame.palms).flatten(1)


def joint_pos(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The agent's joint positions [rad]. Source: paper, Sec. IV-C."""
    return take(frame.now.joint_pos, frame.joints)


def last_action(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The agent's last action. Source: paper, Sec. IV-C."""
    return take(frame.now.action, frame.joints)


def palm_displacement(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """Movement of the palms since the step before [m]. Source: release (always zero there by a slip)."""
    return take(frame.now.palm_pos - frame.before.palm_pos, frame.palms).flatten(1)


def joint_pos_target(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The agent's joint targets [rad]. Source: release."""
    return take(frame.now.joint_pos_target, frame.joints)


def box_age(frame: Frame) -> Float[Tensor, "num_envs 1"]:
    """Age of the newest measured box, by its stamp [control steps]. Source: ours."""
    return frame.now.boxes.age[:, :1]


def box_track(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """The remembered boxes: centre and size of the newest [100 px], speeds between boxes [px/step], ages.

    Source: ours.
    """
    box, age = frame.now.boxes.box, frame.now.boxes.age
    what = torch.cat((0.5 * (box[..., :2] + box[..., 2:]), box[..., 2:] - box[..., :2]), dim=-1)
    gap = (age[:, 1:] - age[:, :-1]).clamp(min=0.5)
    speed = (what[:, :-1] - what[:, 1:]) / gap[..., None]
    return torch.cat((what[:, 0] / 100.0, speed.flatten(1), age), dim=-1)


def box_fit(frame: Frame) -> Float[Tensor, "num_envs k"]:
    """Path and growth of the box, fitted to the remembered boxes and carried on to the present.

    A method that does not see the centre of the box, or not its size, does not see what is fitted to it.
    Source: ours, see `camera.box_history`.
    """
    features = box_history.box_fit(frame.now.boxes.box, frame.now.boxes.age, RGB_CAMERA)
    columns = _fit_columns(frame.pixel_columns)
    if len(columns) == features.shape[-1]:
        return features
    return torch.stack([features[:, column] for column in columns], dim=-1)


@cache
def _fit_columns(pixel_columns: tuple[int, ...]) -> tuple[int, ...]:
    """Columns of `box_fit` that follow from what of a box is seen."""
    seen = {PIXEL_FEATURES[column].lstrip("d") for column in pixel_columns}
    names = enumerate(box_history.BOX_FIT_FEATURES)
    return tuple(column for column, name in names if _is_fit_seen(name, seen))


def _is_fit_seen(name: str, seen: set[str]) -> bool:
    """Whether a feature of the fit follows from what of a box is seen: its centre, its size or both."""
    what = name.removesuffix("_short").removesuffix("_long")
    needs_size = what.startswith("far") or what in ("size", "growth")
    needs_center = what not in ("age", "size", "growth", "far", "far_growth")
    sees_center, sees_size = not seen.isdisjoint(("cx", "cy")), not seen.isdisjoint(("w", "h"))
    return (sees_center or not needs_center) and (sees_size or not needs_size)


PROPRIOCEPTION: tuple[ObservationTerm, ...] = (palm_pose, joint_pos, last_action)
PAPER_TERMS: tuple[ObservationTerm, ...] = (pixels, *PROPRIOCEPTION)
JOURNAL_TERMS: tuple[ObservationTerm, ...] = (*PAPER_TERMS, palm_displacement, joint_pos_target)


def pixel_columns(names: tuple[str, ...]) -> tuple[int, ...]:
    """Columns of named pixel features."""
    return tuple(PIXEL_FEATURES.index(name) for name in names)


def observe(
    terms: tuple[ObservationTerm, ...],
    memory: tuple[ObservationTerm, ...],
    joints: Columns,
    palms: Columns,
    columns: tuple[int, ...],
    history: History,
) -> Float[Tensor, "num_envs size"]:
    """An agent's observation: its terms on both frames of the history, oldest first, then what it remembers.

    The terms of the `memory` look back by themselves, from the newest frame.
    """
    frames = (
        Frame(before=history.oldest, now=history.before, joints=joints, palms=palms, pixel_columns=columns),
        Frame(before=history.before, now=history.now, joints=joints, palms=palms, pixel_columns=columns),
    )
    values = [term(frame) for frame in frames for term in terms]
    return torch.cat([*values, *(term(frames[1]) for term in memory)], dim=-1)


def privileged_state(before: Privileged, now: Privileged) -> Float[Tensor, "num_envs k"]:
    """What the value networks see besides the observations.

    Source: paper (object position, two frames); release (object displacement, object - palm).
    """
    return torch.cat(
        (
            before.object_pos,
            now.object_pos,
            now.object_pos - before.object_pos,
            (now.object_pos[:, None] - now.palm_pos).flatten(1),
            now.object_lin_vel,
            now.is_touching.float(),
            now.is_robot_on_table.float()[:, None],
        ),
        dim=-1,
    )
