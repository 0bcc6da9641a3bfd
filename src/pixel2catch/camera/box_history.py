"""What the last measured boxes say together: where the box is now, how it moves and how it grows.

Pure functions of fixed shape, without a copy to or from the device: they run inside a captured CUDA graph.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.scene.constants import CameraSpec

NUM_BOXES = 16  #: Boxes that `box_fit` is made for. Source: ours, see there.

TIME_CONSTANTS = (3.0, 8.0)
"""Time constants of the weights of the two fits [control steps]. Source: ours, see `box_fit`."""

STEPS_PER_SECOND = 30.0  #: Control steps in a second, for the units of the features. Source: release.

TYPICAL_SIZE = 20.0
"""Mean of width and height whose logarithm counts as 0 [px]. Source: ours, 6 cm at 1.9 m."""

LEAST_SIZE = 2.0  #: Smaller boxes count as this large, so that the logarithm stays finite [px]. Source: ours.

PIXEL_NOISE = 3.0
"""Unit of the residuals [px]. Source: ours; an edge that is up to 5 px off has a deviation of 2.9 px."""

LONGEST_EXTRAPOLATION = 8.0
"""Age of the newest box beyond which the fits wait where they are [control steps]. Source: ours, the longest
latency and four missing boxes; noise of the curvature would carry them out of the image."""

BOUND = 10.0  #: Features end here. Source: ours, several times what a flight reaches.
MOST_FAR = 4.0  #: Largest distance by size [that of TYPICAL_SIZE]. Source: ours, smaller boxes are noise.

SPREAD_FLOOR = 1e-4
"""Variance of normalised time below which a slope fades to 0. Source: ours; boxes a step apart have 1."""

FIT_FEATURES = ("u", "v", "du", "dv", "ddu", "ddv", "size", "growth", "residual")
"""Features of one fit, at age 0: centre from the optical axis [focal lengths], speed [1/s], half of the
acceleration [1/s²], logarithm of the size, its growth [1/s], and what the fit of the centre leaves."""

SCALED_FEATURES = ("far", "far_u", "far_v", "far_du", "far_dv", "far_growth")
"""TYPICAL_SIZE over the size, which is as the distance, and its products with features of the long fit."""

BOX_FIT_FEATURES = (
    *(f"{name}_short" for name in FIT_FEATURES),
    *(f"{name}_long" for name in FIT_FEATURES),
    *SCALED_FEATURES,
    "age",
)
"""Features of `box_fit`, in their order; the age of the newest box is in tenths of a second."""


def box_fit(
    box: Float[Tensor, "num_envs num_boxes 4"], age: Float[Tensor, "num_envs num_boxes"], camera: CameraSpec
) -> Float[Tensor, "num_envs k"]:
    """Fit the last boxes against time with a short and a long memory, and extrapolate to now.

    Centres follow a parabola, logarithms of sizes a line. A box weighs exp(-(its age - the newest age) /
    memory), so that the short fit soon forgets how the object rested before its flight, and the long fit's
    residual tells whether it has. Extrapolation to age 0 makes up for latency and for missing boxes.

    Boxes (xmin, ymin, xmax, ymax) are newest first [px], ages in control steps; equal ages give no slope
    rather than an error. The camera's axis and focal lengths make pixels into directions. Returned are
    `BOX_FIT_FEATURES`, of order 1.

    Source: ours, `benchmarks/sight_information.py`: 0.08 s before a practised thrower's throw comes down, the
    same network after 900 gradient steps errs by 10.6 cm with these features, by 14.2 cm with 8 raw boxes and
    ages, by 12.3 cm with their differences. Windows of 12 or 24 boxes and memories of 4 and 20 steps change
    the mean over all moments and throws by 0.2 cm.
    """
    lower, upper = box[..., :2], box[..., 2:]
    center, size = (lower + upper) / 2.0, (upper - lower).mean(dim=-1).clamp(min=LEAST_SIZE)
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
    """`FIT_FEATURES` of the fit with this memory [control steps]."""
    weight = torch.softmax(-age / memory, dim=-1)[..., None]
    time = (age[:, :1] - age)[..., None] / memory  # the newest box is at 0
    middle = (weight * time).sum(dim=1, keepdim=True)
    ahead = (age[:, :1] / memory).clamp(max=LONGEST_EXTRAPOLATION / memory)[..., None] - middle
    # 1, t - a and (t - a)² - b (t - a) - c are orthogonal under the weights: no equations are left to solve.
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
    """Coefficient of a basis of weighted mean 0 in the values; 0 where the basis vanishes."""
    spread = (weight * basis.square()).sum(dim=1, keepdim=True)
    return (weight * basis * value).sum(dim=1, keepdim=True) / (spread + SPREAD_FLOOR)
