"""How much a training has to randomise the gains of joints that were identified."""

import dataclasses

import numpy as np
from jaxtyping import Float

from pixel2catch.identification.fit import Fit
from pixel2catch.identification.identifiability import half_widths, ratios
from pixel2catch.mdp.randomization import TABLE_1_GAINS, GainRanges
from pixel2catch.mdp.throws import Range
from pixel2catch.robot.constants import JOINTS

LEAST_HALF_WIDTH = 0.02
"""Half-width that is always left, as a share. Source: ours; gains drift with temperature and load."""

LAG = "damping / stiffness"
"""Name of the ratio that says how far a joint lags behind its command."""


def gain_ranges(fit: Fit, before: GainRanges) -> GainRanges:
    """The 95 % intervals of the gains, but never wider than the paper's ranges and never a single point.

    Gains that were not fitted keep their ranges. Where the ratio of damping and stiffness is better known
    than the damping, they are drawn with a common factor: a fit leaves their scale open unless a torque limit
    or a known inertia fixes it, and a damping fitted at an assumed stiffness is right for that one only.

    Args:
        fit: The fit.
        before: The ranges before: the paper's, or those of the dynamics file that the fit started from.
    """
    widths = _half_widths(fit)
    columns = {name: list(values) for name, values in dataclasses.asdict(before).items()}
    for j, name in enumerate(fit.dynamics.joints):
        row = [joint.name for joint in JOINTS].index(name)
        stiffness, damping, lag = (widths[key][j] for key in ("stiffness", "damping", LAG))
        if np.isfinite(stiffness):
            columns["stiffness_scale"][row] = _within(TABLE_1_GAINS[row], stiffness)
        if np.isfinite(damping) or np.isfinite(lag):
            columns["damping_scale"][row] = _within(TABLE_1_GAINS[row], min(damping, lag))
            columns["is_damping_relative"][row] = bool(lag < damping)
    return GainRanges(**{name: tuple(values) for name, values in columns.items()})


def _half_widths(fit: Fit) -> dict[str, Float[np.ndarray, " num_joints"]]:
    """Half of the 95 % intervals of gains and lag, in logarithms; infinite for what was not fitted."""
    unknown = np.full(len(fit.dynamics.joints), np.inf)
    widths = dict(zip(fit.free, half_widths(fit).T, strict=True))
    of_ratios = {ratio.name: ratio.half_width for ratio in ratios(fit)}
    stiffness, damping = (widths.get(name, unknown) for name in ("stiffness", "damping"))
    if "stiffness" not in widths:
        return {"stiffness": unknown, "damping": unknown, LAG: damping}
    return {"stiffness": stiffness, "damping": damping, LAG: of_ratios.get(LAG, unknown)}


def _within(widest: Range, half_width: float) -> Range:
    """The factors of an interval, within the widest range."""
    width = min(max(half_width, LEAST_HALF_WIDTH), 1.0)  # e is more than any range has
    low, high = np.clip(np.exp((-width, width)), *widest)
    return float(low), float(high)
