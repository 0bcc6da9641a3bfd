"""Observation terms: pure functions of a frame, the same in training and on the robot.

An agent's observation is its terms on two consecutive frames: see `methods.Method.observe`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.batches import Boxes, Features, Vectors
from pixel2catch.camera.level import level_sight
from pixel2catch.camera.pinhole import center_and_size, project
from pixel2catch.checks import NAMED
from pixel2catch.devices import constant
from pixel2catch.mdp.control_step import Columns, Measurement, Privileged, take
from pixel2catch.scene.constants import RGB_CAMERA, CameraSpec

PIXEL_FEATURES = ("cx", "cy", "w", "h", "dcx", "dcy", "dw", "dh")
"""Centre and size of the box as shares of the image, and their changes since the last control step [px]."""


@dataclass(frozen=True, kw_only=True)
class ObservationInputs:
    """Inputs of the observation terms of one agent: the measurements of two consecutive control steps."""

    before: Measurement  #: The measurement one control step earlier.
    now: Measurement  #: The measurement.
    joints: Columns  #: The agent's columns in joint order.
    palms: Columns  #: Columns of the palms on the agent's robots.
    pixel_columns: tuple[int, ...]  #: The columns of `PIXEL_FEATURES` that the method uses.


ObservationTerm = Annotated[Callable[[ObservationInputs], Features], NAMED]


def pixel_features(before: Boxes, now: Boxes, camera: CameraSpec) -> Float[Tensor, "num_envs 8"]:
    """Return every pixel feature of two successive boxes [px], in the order of `PIXEL_FEATURES`.

    z = {cx, cy, w, h, Δcx, Δcy, Δw, Δh}; the paper's method uses all but w and h.

    Source: paper, Eq. 1; release: cx / width and cy / height, differences in pixels; ours: w / width and
    h / height.
    """
    center, old_center = ((box[:, :2] + box[:, 2:]) / 2 for box in (now, before))
    size, old_size = (box[:, 2:] - box[:, :2] for box in (now, before))
    width, height = camera.width, camera.height
    shares = (center[:, 0] / width, center[:, 1] / height, size[:, 0] / width, size[:, 1] / height)
    return torch.cat((torch.stack(shares, dim=-1), center - old_center, size - old_size), dim=-1)


def pixels(frame: ObservationInputs) -> Features:
    """Return the method's pixel features z. Source: paper, Eq. 1."""
    features = pixel_features(frame.before.box, frame.now.box, RGB_CAMERA)
    return torch.stack([features[:, column] for column in frame.pixel_columns], dim=-1)


def object_position(frame: ObservationInputs) -> Float[Tensor, "num_envs 6"]:
    """Return the object's position and its change in a step, world frame [m]. Source: ours (oracle)."""
    return torch.cat((frame.now.object_pos, frame.now.object_pos - frame.before.object_pos), dim=-1)


def object_extent(frame: ObservationInputs) -> Float[Tensor, "num_envs 2"]:
    """Return width and height of the box at the object's distance [m]. Source: ours (oracle)."""
    (_, size), (_, depth) = center_and_size(frame.now.box), project(RGB_CAMERA, frame.now.object_pos[:, None])
    return size * depth / constant((RGB_CAMERA.fx, RGB_CAMERA.fy), size.device)


def initial_object_position(frame: ObservationInputs) -> Vectors:
    """Return the first object position of the episode, by a tracker [m]. Source: paper, Sec. V-A (w/o-PF)."""
    return frame.now.initial_object_pos


def palm_pose(frame: ObservationInputs) -> Features:
    """Return position [m] and orientation (w, x, y, z) of the agent's palms. Source: paper, Sec. IV-C."""
    pose = torch.cat((frame.now.palm_pos, frame.now.palm_quat), dim=-1)
    return take(pose, frame.palms).flatten(1)


def joint_pos(frame: ObservationInputs) -> Features:
    """Return the agent's joint positions [rad]. Source: paper, Sec. IV-C."""
    return take(frame.now.joint_pos, frame.joints)


def last_action(frame: ObservationInputs) -> Features:
    """Return the agent's last action. Source: paper, Sec. IV-C."""
    return take(frame.now.action, frame.joints)


def palm_displacement(frame: ObservationInputs) -> Features:
    """Return the movement of the palms in a step [m]. Source: release (always zero there by mistake)."""
    return take(frame.now.palm_pos - frame.before.palm_pos, frame.palms).flatten(1)


def joint_pos_target(frame: ObservationInputs) -> Features:
    """Return the agent's joint targets [rad]. Source: release."""
    return take(frame.now.joint_pos_target, frame.joints)


def box_age(frame: ObservationInputs) -> Float[Tensor, "num_envs 1"]:
    """Return the age of the newest measured box, by its stamp [control steps]. Source: ours."""
    return frame.now.boxes.age[:, :1]


def measured_boxes(frame: ObservationInputs) -> Features:
    """Return the four edges of all measured boxes [px], then their ages [control steps]. Source: ours."""
    boxes = frame.now.boxes
    return torch.cat((boxes.box.transpose(1, 2), boxes.age[:, None]), dim=1).flatten(1)


def camera_position(frame: ObservationInputs) -> Vectors:
    """Return the place of the calibrated camera [m]. Source: ours, for policies of any camera."""
    return frame.now.camera_pos


def palm_sight(frame: ObservationInputs) -> Features:
    """Return where the level camera sees the agent's palms: see `camera.level.level_sight` (ours)."""
    return level_sight(take(frame.now.palm_pos, frame.palms), frame.now.camera_pos).flatten(1)


def box_track(frame: ObservationInputs) -> Features:
    """Return centre and size of the newest box [100 px], speeds between boxes [px/step], and ages (ours)."""
    age, what = frame.now.boxes.age, torch.cat(center_and_size(frame.now.boxes.box), dim=-1)
    gap = (age[:, 1:] - age[:, :-1]).clamp(min=0.5)
    speed = (what[:, :-1] - what[:, 1:]) / gap[..., None]
    return torch.cat((what[:, 0] / 100.0, speed.flatten(1), age), dim=-1)


def box_fit(frame: ObservationInputs) -> Features:
    """Return path and growth of the box, fitted to recent boxes and extrapolated to the present.

    Features that need the centre or the size of the box are left out where the method does not observe it.
    Source: ours, see `fit_boxes`.
    """
    features = fit_boxes(frame.now.boxes.box, frame.now.boxes.age, RGB_CAMERA)
    return torch.stack([features[:, column] for column in _fit_columns(frame.pixel_columns)], dim=-1)


@cache
def _fit_columns(pixel_columns: tuple[int, ...]) -> tuple[int, ...]:
    seen = {PIXEL_FEATURES[column].lstrip("d") for column in pixel_columns}
    return tuple(column for column, name in enumerate(BOX_FIT_FEATURES) if _is_fit_seen(name, seen))


def _is_fit_seen(name: str, seen: set[str]) -> bool:
    """Return whether a feature of the fit follows from the observed centre, size or both."""
    what = name.removesuffix("_short").removesuffix("_long")
    needs_size = what.startswith("far") or what in ("size", "growth")
    needs_center = what not in ("age", "size", "growth", "far", "far_growth")
    sees_center, sees_size = not seen.isdisjoint(("cx", "cy")), not seen.isdisjoint(("w", "h"))
    return (sees_center or not needs_center) and (sees_size or not needs_size)


PROPRIOCEPTION: tuple[ObservationTerm, ...] = (palm_pose, joint_pos, last_action)
PAPER_TERMS: tuple[ObservationTerm, ...] = (pixels, *PROPRIOCEPTION)
JOURNAL_TERMS: tuple[ObservationTerm, ...] = (*PAPER_TERMS, palm_displacement, joint_pos_target)


def pixel_columns(names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the columns of named pixel features."""
    return tuple(PIXEL_FEATURES.index(name) for name in names)


def privileged_state(before: Privileged, now: Privileged) -> Features:
    """Return the input of the value networks besides the observations.

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


NUM_BOXES = 16  #: Boxes that `fit_boxes` takes. Source: ours, experiments/LOG.md, 2026-11-22.

TIME_CONSTANTS = (3.0, 8.0)  #: Of the weights of the two fits [control steps]. Source: ours, as above.

STEPS_PER_SECOND = 30.0  #: Control steps in a second, for the units of the features. Source: release.

TYPICAL_SIZE = 20.0  #: Mean of width and height whose logarithm is 0 [px]. Source: ours, 6 cm at 1.9 m.

LEAST_SIZE = 2.0  #: Smaller boxes count as this large, so that the logarithm stays finite [px]. Source: ours.

PIXEL_NOISE = 3.0
"""Unit of the residuals [px]. Source: ours; an edge that is up to 5 px off has a deviation of 2.9 px."""

LONGEST_EXTRAPOLATION = 8.0
"""Longest time of extrapolation [control steps]. Source: ours, the longest latency and four missing boxes."""

BOUND = 10.0  #: Largest absolute value of a feature. Source: ours, several times that of a flight.
MOST_FAR = 4.0  #: Largest distance [that of a box of TYPICAL_SIZE]. Source: ours, smaller boxes are noise.

SPREAD_FLOOR = 1e-4
"""Variance of normalised time below which a slope fades to 0. Source: ours; boxes a step apart have 1."""

FIT_FEATURES = ("u", "v", "du", "dv", "ddu", "ddv", "size", "growth", "residual")
"""Features of one fit, at age 0: centre from the optical axis [focal lengths], speed [1/s], half of the
acceleration [1/s²], logarithm of the size, its growth [1/s], and the residual of the centre."""

SCALED_FEATURES = ("far", "far_u", "far_v", "far_du", "far_dv", "far_growth")
"""The first is TYPICAL_SIZE over the size in the long fit; it grows with the distance. The others are its
products with other features of the long fit."""

BOX_FIT_FEATURES = (
    *(f"{name}_short" for name in FIT_FEATURES),
    *(f"{name}_long" for name in FIT_FEATURES),
    *SCALED_FEATURES,
    "age",
)
"""Features of `box_fit`, in their order; the age of the newest box is in tenths of a second."""


def fit_boxes(
    box: Float[Tensor, "num_envs num_boxes 4"], age: Float[Tensor, "num_envs num_boxes"], camera: CameraSpec
) -> Features:
    """Return `BOX_FIT_FEATURES`: fits of recent boxes against time, extrapolated to the present.

    Centres follow a parabola, logarithms of sizes a line. A box weighs exp(-(its age - the newest age) / T),
    once with a short and once with a long time constant T. Equal ages give no slope. Boxes [px] are newest
    first, with their ages [control steps]. Axis and focal lengths of the camera turn pixels into directions.

    Source: ours, experiments/LOG.md, 2026-11-22.
    """
    center, sides = center_and_size(box)
    size = sides.mean(dim=-1).clamp(min=LEAST_SIZE)
    direction = torch.stack(
        ((center[..., 0] - camera.cx) / camera.fx, (center[..., 1] - camera.cy) / camera.fy), dim=-1
    )
    logarithm = torch.log(size / TYPICAL_SIZE)[..., None]
    fits = [_fit_features(direction, logarithm, age, memory, camera) for memory in TIME_CONSTANTS]
    long = fits[-1]
    far = torch.exp(-long[:, 6:7]).clamp(max=MOST_FAR)  # in sizes of the object instead of angles
    scaled = torch.cat((far, far * long[:, :4], far * long[:, 7:8]), dim=-1).clamp(-BOUND, BOUND)
    return torch.cat((*fits, scaled, age[:, :1] * (10.0 / STEPS_PER_SECOND)), dim=-1)


def _fit_features(
    direction: Float[Tensor, "num_envs num_boxes 2"],
    logarithm: Float[Tensor, "num_envs num_boxes 1"],
    age: Float[Tensor, "num_envs num_boxes"],
    memory: float,
    camera: CameraSpec,
) -> Float[Tensor, "num_envs 9"]:
    """Return the `FIT_FEATURES` of the fit with this time constant [control steps]."""
    weight = torch.softmax(-age / memory, dim=-1)[..., None]
    time = (age[:, :1] - age)[..., None] / memory  # the newest box is at 0
    middle = (weight * time).sum(dim=1, keepdim=True)
    ahead = (age[:, :1] / memory).clamp(max=LONGEST_EXTRAPOLATION / memory)[..., None] - middle
    # 1, t - a and (t - a)² - b (t - a) - c are orthogonal under the weights.
    linear = time - middle
    square = linear.square()
    skew = _slope(square, linear, weight)
    variance = (weight * square).sum(dim=1, keepdim=True)
    curved = square - variance - skew * linear

    mean = (weight * direction).sum(dim=1, keepdim=True)
    slope, bend = _slope(direction, linear, weight), _slope(direction, curved, weight)
    rest = direction - mean - slope * linear - bend * curved
    residual = torch.sqrt((weight * rest.square()).sum(dim=(1, 2)))[:, None]
    now = mean + slope * ahead + bend * (ahead.square() - variance - skew * ahead)
    speed = slope + bend * (2.0 * ahead - skew)

    growth = _slope(logarithm, linear, weight)
    size_now = (weight * logarithm).sum(dim=1, keepdim=True) + growth * ahead
    rate = STEPS_PER_SECOND / memory
    at_now = torch.cat((now, rate * speed, rate * rate * bend, size_now, rate * growth), dim=-1)[:, 0]
    return torch.cat((at_now, residual * (camera.fx / PIXEL_NOISE)), dim=-1).clamp(-BOUND, BOUND)


def _slope(
    value: Float[Tensor, "num_envs num_boxes n"],
    basis: Float[Tensor, "num_envs num_boxes 1"],
    weight: Float[Tensor, "num_envs num_boxes 1"],
) -> Float[Tensor, "num_envs 1 n"]:
    """Return the coefficient of a basis of weighted mean 0 in the values; 0 where the basis vanishes."""
    spread = (weight * basis.square()).sum(dim=1, keepdim=True)
    return (weight * basis * value).sum(dim=1, keepdim=True) / (spread + SPREAD_FLOOR)
