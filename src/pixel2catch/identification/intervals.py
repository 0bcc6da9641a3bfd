"""How well a fit is known: noise, what changes from motion to motion, and what models leave out.

The last is stated, not measured: a robot's torque limit, its friction at rest and its cycle are not quite
those of any simulation, whatever the recordings say.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.special import stdtrit

from pixel2catch.robots.joint_dynamics import JointDynamics

CONFIDENCE = 1.96  # standard deviations in half a 95 % interval
BLOCK = 2.0  # length of the parts of the motion that are compared [s] (ours, the length of a kind of motion)

LIMIT_DEVIATION = 0.15
"""Of the torque limit, and of the inertia of the links, as a share. Source: ours. They are all that tells the
common scale of a joint's torques; viscous friction that the limit does not hold back was 8 % of it
(`benchmarks/identify_independent_truth.py`)."""

FRICTION_DEVIATION = 0.1
"""Of dry friction, as a share. Source: ours; friction at rest is 10 to 30 % above that in motion, and motion
shows something in between."""

LAG_DEVIATION = 0.003
"""Of damping over stiffness, as a share. Source: ours: by so much, in the root mean square, single joints of
another robot were off beyond what changes from motion to motion (seeds 30, 31 and 40 of
`benchmarks/identify_independent_truth.py`)."""

LATENCY_DEVIATION = 4e-4
"""Of the latency [s], of its change in a recording, and of inertia over damping. Source: ours, of the order
of a servo's cycle: a command waits for the next one, which looks like latency or like inertia. Armature over
damping of every joint, identified from recordings of the twin, was 0.42 ms more than the twin's, and stiff
wrists of another robot had torques 1.6 and 1.9 times too large (seed 50 of the same)."""

Hessian = Float[np.ndarray, "num_directions num_directions"]


def block_covariance(hessian: Hessian, scores: Float[np.ndarray, "num_blocks num_directions"]) -> Hessian:
    """Covariance of the minimum of squares, from the derivatives that each block of the motion adds to it.

    The derivatives add up to zero there; how far those of single blocks are from it tells how much
    the minimum moves from motion to motion, noise that is correlated and wrong models included: the sandwich
    estimator (Huber 1967), with Student's factor for few blocks. That of white noise is added.
    """
    num = len(scores)
    factor = (float(stdtrit(num - 1, 0.975)) / CONFIDENCE) ** 2 * num / (num - 1) if num > 1 else 1.0
    inverse = np.linalg.inv(hessian)
    return inverse + factor * inverse @ (scores.T @ scores) @ inverse


def block_scores(
    changes: Float[np.ndarray, "num_directions num_settled"],
    weighted: Float[np.ndarray, " num_settled"],
    starts: Int[np.ndarray, " num_blocks"],
) -> Float[np.ndarray, "num_blocks num_directions"]:
    """Derivatives that each block adds, from those of every position and the weighted residuals."""
    return np.add.reduceat(changes * weighted, starts, axis=1).T


def model_covariance(
    dynamics: JointDynamics,
    armature: Float[np.ndarray, " num_joints"],
    link_inertia: Float[np.ndarray, " num_joints"],
    free: Sequence[str],
    latency_unit: float,
) -> Float[np.ndarray, "num_joints num_free num_free"]:
    """Covariance of the logarithms of free parameters, and of the latency in a unit [s], of what models lack.

    With another torque limit, the same motion has another common scale; the armature makes up for what
    the inertia of the links [kg·m²] should have changed. What the servo's cycle adds to the time in which a
    joint gains speed, inertia over damping, looks like more armature, or, where the torque limit tells the
    inertia, like less torque in everything else.
    Where the armature is the smaller part it tells nothing: it is at most what it was in the beginning
    [kg·m²] there, as logarithms are lopsided.
    """
    least = np.minimum(dynamics.armature, armature)
    heaviness, has_scale = link_inertia / least, "stiffness" in free
    own = {
        "damping": LAG_DEVIATION,
        "frictionloss": FRICTION_DEVIATION,
        "latency": LATENCY_DEVIATION / latency_unit,
    }
    scale, servo, link, cycle = np.zeros((4, len(dynamics.joints), len(free)))
    for i, name in enumerate(free):
        if name in ("stiffness", "damping", "frictionloss"):
            scale[:, i] = has_scale * LIMIT_DEVIATION
            servo[:, i] = (
                has_scale * LATENCY_DEVIATION * dynamics.damping / (dynamics.armature + link_inertia)
            )
        if name == "armature":
            scale[:, i] = has_scale * LIMIT_DEVIATION * (1.0 + heaviness)
            link[:, i] = LIMIT_DEVIATION * heaviness
            cycle[:, i] = LATENCY_DEVIATION * dynamics.damping / least
    deviations = np.stack((scale, servo, link, cycle))
    alone = np.diag([own.get(name, 0.0) ** 2 for name in free])
    return np.einsum("mja,mjb->jab", deviations, deviations) + alone


def play_deviation(dynamics: JointDynamics) -> Float[np.ndarray, " num_joints"]:
    """How far the play of an encoder is open as long as dry friction is [rad].

    A joint that turns around stays where it is until its command has moved by the play and
    2 frictionloss / stiffness.
    """
    return 2.0 * FRICTION_DEVIATION * dynamics.frictionloss / dynamics.stiffness
