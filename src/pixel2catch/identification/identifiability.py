"""What recordings tell about the dynamics, and what they do not, in words and with a way out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pixel2catch.identification.fit import Fit
from pixel2catch.identification.fit_problem import LATENCY_UNIT, SCALE

CONFIDENCE = 1.96
"""Standard deviations in half a 95 % interval."""

WELL_KNOWN = 0.1
"""Half-width of an interval up to which a parameter counts as identified: 10 %, or 1 ms. Source: ours."""

NOTABLE = 0.3
"""Share of a weak direction's largest component from which a parameter is named. Source: ours."""

UNITS = {
    "stiffness": "N·m/rad",
    "damping": "N·m·s/rad",
    "frictionloss": "N·m",
    "armature": "kg·m²",
    "latency": "s",
    "filter_gain": "1/s²",
    "filter_lookahead": "s",
}
"""Units of the parameters."""

EXCITATION = {
    "stiffness": "add motion that reaches the torque limit, or a known payload",
    "damping": "add faster motion",
    "frictionloss": "add slow reversals",
    "armature": "add steps and faster changes of speed",
    "latency": "add steps",
    "filter_gain": "add steps",
    "filter_lookahead": "add 20 Hz targets of changing speed",
}
"""What shows a parameter in positions."""


@dataclass(frozen=True, kw_only=True)
class WeakDirection:
    """Parameters of a joint that can change together with hardly a change of its motion.

    Attributes:
        joint: Name of the joint.
        parameters: Names of the parameters, the one that changes most first.
        half_width: Half of the 95 % interval along the direction, in the coordinates of the fit.
        is_scale: Whether all of them grow together, so that their ratios are known.
    """

    joint: str
    parameters: tuple[str, ...]
    half_width: float
    is_scale: bool

    @property
    def meaning(self) -> str:
        """The direction in a sentence."""
        names = " and ".join(self.parameters)
        if len(self.parameters) == 1:
            is_latency = self.parameters == ("latency",)
            width = self.half_width * LATENCY_UNIT if is_latency else np.exp(min(self.half_width, 9.0))
            known = f"to {1e3 * width:.1f} ms" if is_latency else f"to a factor of {width:.3g}"
            return f"{names} of {self.joint} is known {known} only"
        if self.is_scale:
            return f"{names} of {self.joint} share one scale: only their ratios are known"
        return f"{names} of {self.joint} stand in for each other"

    @property
    def proposal(self) -> str:
        """What to do about it."""
        fixed = "stiffness" if self.is_scale and "stiffness" in self.parameters else self.parameters[0]
        return f"fix {fixed} (leave it out of what is free), or {EXCITATION[fixed]}"


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """The ratio of two parameters, which is often known where they are not.

    Attributes:
        name: "damping / stiffness" and the like.
        unit: Its unit.
        value: Of each joint.
        half_width: Half of the 95 % interval of its logarithm.
    """

    name: str
    unit: str
    value: Float[np.ndarray, " num_joints"]
    half_width: Float[np.ndarray, " num_joints"]


RATIOS = {
    ("damping", "stiffness"): "s",
    ("armature", "stiffness"): "s²",
    ("frictionloss", "stiffness"): "rad",
}
"""The ratios that decide how a joint follows its command, with their units."""


def half_widths(fit: Fit) -> Float[np.ndarray, "num_joints num_free"]:
    """Half of each parameter's 95 % interval, in the coordinates of the fit.

    That is of the logarithm, so that 0.1 is ±10 %, and for the latency of 10 ms. Where it is
    `CONFIDENCE * fit.prior`, the recordings tell nothing. It is by how much noise may move the result; what
    a robot does and no simulation of its joints is not in it.
    """
    return CONFIDENCE * np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))


def weak_directions(fit: Fit, limit: float = WELL_KNOWN) -> tuple[WeakDirection, ...]:
    """The directions in which a joint's parameters are not identified, widest first.

    Args:
        fit: The fit.
        limit: Half-width up to which a direction counts as identified.
    """
    found = []
    for joint, covariance in zip(fit.dynamics.joints, fit.covariance, strict=True):
        variances, directions = np.linalg.eigh(covariance)
        for variance, direction in zip(variances, directions.T, strict=True):
            if CONFIDENCE * np.sqrt(variance) > limit:
                found.append(_named(joint, fit.free, direction, CONFIDENCE * float(np.sqrt(variance))))
    return tuple(sorted(found, key=lambda weak: -weak.half_width))


def _named(joint: str, free: Sequence[str], direction: np.ndarray, half_width: float) -> WeakDirection:
    """Name the parameters that take part in a direction."""
    order = [int(i) for i in np.argsort(-np.abs(direction))]
    part = [i for i in order if abs(direction[i]) > NOTABLE * abs(direction[order[0]])]
    is_scale = all(free[i] in SCALE and direction[i] * direction[part[0]] > 0 for i in part)
    return WeakDirection(
        joint=joint,
        parameters=tuple(free[i] for i in part),
        half_width=half_width,
        is_scale=is_scale and len(part) > 1,
    )


def ratios(fit: Fit) -> tuple[Ratio, ...]:
    """The ratios of which both parameters were fitted."""
    found = []
    for (above, below), unit in RATIOS.items():
        if {above, below} <= set(fit.free):
            difference = np.zeros(len(fit.free))
            difference[fit.free.index(above)], difference[fit.free.index(below)] = 1.0, -1.0
            variance = np.einsum("a,jab,b->j", difference, fit.covariance, difference)
            value = getattr(fit.dynamics, above) / getattr(fit.dynamics, below)
            width = CONFIDENCE * np.sqrt(variance)
            found.append(Ratio(name=f"{above} / {below}", unit=unit, value=value, half_width=width))
    return tuple(found)
