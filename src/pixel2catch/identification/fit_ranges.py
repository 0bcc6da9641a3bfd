"""How much a training has to randomise the gains of joints that were identified."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pixel2catch.identification.fit import Fit
from pixel2catch.identification.identifiability import half_widths
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.robot.constants import ARM_JOINTS

LEAST_HALF_WIDTH = 0.02
"""Half-width that is always left, as a share. Source: ours; gains drift with temperature and load."""


@dataclass(frozen=True, kw_only=True)
class GainRanges:
    """Factors on the gains of each joint, lowest and highest.

    Attributes:
        joints: Names of the joints.
        stiffness_scale: Factors on the stiffness.
        damping_scale: Factors on the damping.
    """

    joints: tuple[str, ...]
    stiffness_scale: Float[np.ndarray, "num_joints 2"]
    damping_scale: Float[np.ndarray, "num_joints 2"]


def gain_ranges(fit: Fit, paper: RandomizationCfg) -> GainRanges:
    """The 95 % intervals of the gains, but never wider than the paper's ranges and never a single point.

    A gain that was not fitted keeps the paper's range.

    Args:
        fit: The fit.
        paper: The ranges for joints of which nothing is known.
    """
    arm = {joint.name for joint in ARM_JOINTS}
    widest = np.array(
        [paper.arm_gain_scale if name in arm else paper.hand_gain_scale for name in fit.dynamics.joints]
    )
    widths = dict(zip(fit.free, half_widths(fit).T, strict=True))

    def scale(name: str) -> Float[np.ndarray, "num_joints 2"]:
        if name not in widths:
            return widest
        width = np.maximum(widths[name], LEAST_HALF_WIDTH)
        ranges = np.exp(np.stack((-width, width), axis=-1))
        return np.clip(ranges, widest[:, :1], widest[:, 1:])

    return GainRanges(
        joints=fit.dynamics.joints, stiffness_scale=scale("stiffness"), damping_scale=scale("damping")
    )
