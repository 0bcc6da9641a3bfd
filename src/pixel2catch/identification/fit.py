"""The fit: the joint dynamics under which simulation moves as the robot did.

Least squares on positions, in logarithms of the parameters (the latency in units of 10 ms), so that every
parameter has a natural scale and stays positive. A broad prior about the start keeps in place what the
recordings do not tell. Not `mujoco.sysid`: it compiles a model for every column of the Jacobian and applies
commands open-loop, without the servos' torque limit and friction.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pixel2catch.identification.fit_problem import FitCfg, Point, Problem
from pixel2catch.identification.fit_simulation import FIT_DT, RecordedMotion
from pixel2catch.identification.recording import Recording
from pixel2catch.robot.joint_dynamics import JointDynamics

LAG_PARAMETERS = ("damping", "filter_lookahead", "latency")
"""What is fitted first, alone: else an unexplained lag drives the armature into a far, wrong minimum."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A fit and how well its recordings determine it.

    Attributes:
        dynamics: The fitted dynamics.
        free: The parameters that were fitted.
        covariance: Of each joint's free parameters, in the coordinates of the fit; the prior is in it.
        prior: Standard deviation of the prior: where it is not reduced, the recordings tell nothing.
        residual: Simulated minus measured positions of the fitted recordings [rad].
    """

    dynamics: JointDynamics
    free: tuple[str, ...]
    covariance: Float[np.ndarray, "num_joints num_free num_free"]
    prior: float
    residual: Float[np.ndarray, "num_settled num_joints"]


def fit_dynamics(recordings: Sequence[Recording], start: JointDynamics, cfg: FitCfg) -> Fit:
    """Fit the free parameters of every joint to the recordings.

    Args:
        recordings: What to fit; hold whole recordings out to judge the result with `tracking_error`.
        start: Start values, and the values of what is not free.
        cfg: How to fit.

    Raises:
        RecordingError: There is no recording, one is too short, or they are of different joints.
        InvalidValueError: The start is of other joints, or has no filter where one is to be fitted.
    """
    problem = Problem(recordings, start, cfg)
    lag = problem.solve(problem.start, LAG_PARAMETERS)
    point = problem.solve(lag, cfg.free)
    residual = problem.errors(point)
    return Fit(
        dynamics=problem.coordinates.dynamics(point),
        free=cfg.free,
        covariance=_covariance(problem, point, residual, cfg.prior),
        prior=cfg.prior,
        residual=residual,
    )


def _covariance(
    problem: Problem, point: Point, residual: Float[np.ndarray, "num_settled num_joints"], prior: float
) -> Float[np.ndarray, "num_joints num_free num_free"]:
    """Covariance of each joint's parameters, with those of the other joints unknown as well.

    Each joint's errors weigh as their own size tells, and count as often as they are independent.
    """
    shifts = np.eye(point.size).reshape(point.size, *point.shape)
    columns = problem.derivatives(point, shifts)
    variance = np.mean(residual**2, axis=0) * correlation_time(residual)
    scaled = (columns / np.sqrt(variance)).reshape(point.size, -1)
    full = np.linalg.inv(scaled @ scaled.T + np.eye(point.size) / prior**2)
    num_joints, num_free = point.shape
    blocks = full.reshape(num_joints, num_free, num_joints, num_free)
    return np.stack([blocks[j, :, j, :] for j in range(num_joints)])


def tracking_error(
    recordings: Sequence[Recording], dynamics: JointDynamics, physics_dt: float = FIT_DT
) -> Float[np.ndarray, " num_joints"]:
    """Root mean square of simulated minus measured positions, per joint [rad].

    Args:
        recordings: Of the joints of `dynamics`; such that were not fitted tell how good a fit is.
        dynamics: What is judged.
        physics_dt: Time step of the simulation [s].

    Raises:
        RecordingError: There is no recording, one is too short, or they are of different joints.
    """
    motion = RecordedMotion([recording.select(dynamics.joints) for recording in recordings], physics_dt)
    (simulated,) = motion.simulate([dynamics])
    return np.sqrt(np.mean((simulated - motion.measured) ** 2, axis=0))


def correlation_time(
    residual: Float[np.ndarray, "num_samples num_joints"],
) -> Float[np.ndarray, " num_joints"]:
    """How many consecutive samples tell one independent thing: 1 for white noise, more for model errors.

    It is 1 plus twice the sum of the autocorrelations up to the first that is not positive.
    """
    centered = residual - residual.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(centered, n=2 * len(residual), axis=0)) ** 2
    correlation = np.fft.irfft(spectrum, axis=0)[: len(residual)]
    correlation = correlation / np.maximum(correlation[0], np.finfo(float).tiny)
    is_before = np.cumprod(correlation > 0.0, axis=0)
    return np.maximum(2.0 * (correlation * is_before).sum(axis=0) - 1.0, 1.0)
