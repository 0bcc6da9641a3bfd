"""Covariance of a fit: noise, changes from motion to motion, and errors of the model.

The last is stated, not measured: a robot's torque limit, its friction at rest and its cycle differ from those
of any simulation, whatever the recordings are.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from pixel2catch.robots.joint_dynamics import JointDynamics

CONFIDENCE = 1.96  # standard deviations in half a 95 % interval
BLOCK = 2.0  # length of the parts of the motion that are compared [s] (ours, the length of a kind of motion)

LIMIT_DEVIATION = 0.15
"""Deviation of the torque limit, and of the inertia of the links, as a share. Source: ours. Only they fix the
common scale of a joint's torques; viscous friction that the limit does not hold back was 8 % of it
(`benchmarks/identify_independent_truth.py`)."""

FRICTION_DEVIATION = 0.1
"""Deviation of dry friction, as a share. Source: ours; at rest it is 10 to 30 % above that in motion.
Friction of fingers that differs by ±20 % between directions made damping 2.6 % larger."""

LAG_DEVIATION = 0.008
"""Deviation of damping over stiffness, as a share. Source: ours: error of joints on belts (the same)."""

LATENCY_DEVIATION = 4e-4
"""Deviation of the latency [s], of its change in a recording, and of inertia over damping. Source: ours, of
the order of a servo's cycle: a command waits for the next one, which looks like latency or like inertia.
Armature over damping of every joint, identified from recordings of the twin, was 0.42 ms more than the
twin's, and stiff wrists of another robot had torques 1.6 and 1.9 times too large (seed 50 of the same)."""

PerJoint = Float[np.ndarray, " num_joints"]
Hessian = Float[np.ndarray, "num_directions num_directions"]


def block_covariance(hessian: Hessian, scores: Float[np.ndarray, "num_blocks num_directions"]) -> Hessian:
    """Return the covariance of the minimum of squares, from the derivatives that each block adds to it.

    The derivatives add up to zero there; their spread over blocks shows how much the minimum moves from
    motion to motion, with correlated noise and wrong models: the sandwich estimator (Huber 1967), with
    Student's factor for few blocks. The covariance of white noise is added.
    """
    num = len(scores)
    factor = (float(stdtrit(num - 1, 0.975)) / CONFIDENCE) ** 2 * num / (num - 1) if num > 1 else 1.0
    inverse = np.linalg.inv(hessian)
    return inverse + factor * inverse @ (scores.T @ scores) @ inverse


def lag_deviation(dynamics: JointDynamics, speed: PerJoint) -> PerJoint:
    """Return the deviation of damping over stiffness, as a share, of joints that move at a speed [rad/s]."""
    share = dynamics.frictionloss / (dynamics.damping * speed)
    return np.hypot(LAG_DEVIATION, FRICTION_DEVIATION * share)


def model_covariance(
    dynamics: JointDynamics,
    armature: PerJoint,
    link_inertia: PerJoint,
    speed: PerJoint,
    free: Sequence[str],
    latency_unit: float,
) -> Float[np.ndarray, "num_joints num_free num_free"]:
    """Return the covariance of the logarithms of free parameters that the model's errors cause.

    With another torque limit, the same motion has another common scale; the armature compensates what the
    links' inertia should have changed. The servo's cycle delays the gain of speed, which looks like more
    armature, or, where the torque limit fixes the inertia, like less torque in everything else. Friction that
    differs by direction or load looks like damping, which latency compensates in part.

    Of the armatures [kg·m²] before and after the fit the smaller counts, as logarithms are lopsided. The link
    inertia is what each joint moves beside its armature [kg·m²], the speed that of its motion [rad/s]. The
    latency unit counts as 1 [s].
    """
    least, inertia = np.minimum(dynamics.armature, armature), dynamics.armature + link_inertia
    heaviness, has_scale = link_inertia / least, "stiffness" in free
    own = {"frictionloss": FRICTION_DEVIATION, "latency": LATENCY_DEVIATION / latency_unit}
    deviation = lag_deviation(dynamics, speed)
    scale, servo, link, cycle, lag = np.zeros((5, len(dynamics.joints), len(free)))
    for i, name in enumerate(free):
        if name in ("stiffness", "damping", "frictionloss"):
            scale[:, i] = has_scale * LIMIT_DEVIATION
            servo[:, i] = has_scale * LATENCY_DEVIATION * dynamics.damping / inertia
        if name == "armature":
            scale[:, i] = has_scale * LIMIT_DEVIATION * (1.0 + heaviness)
            link[:, i] = LIMIT_DEVIATION * heaviness
            cycle[:, i] = LATENCY_DEVIATION * dynamics.damping / least
        if name == "damping":
            lag[:, i] = deviation
        if name == "latency":
            lag[:, i] = -deviation * dynamics.damping / dynamics.stiffness / (2 * latency_unit)
    deviations = np.stack((scale, servo, link, cycle, lag))
    alone = np.diag([own.get(name, 0.0) ** 2 for name in free])
    return np.einsum("mja,mjb->jab", deviations, deviations) + alone
