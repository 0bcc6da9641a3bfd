"""The fit: the joint dynamics under which simulation moves as the robot did.

Least squares on positions, in logarithms of the parameters (the latency in units of 10 ms), so that every
parameter has a natural scale and stays positive. A broad prior about the start keeps in place what the
recordings do not tell. Not `mujoco.sysid`: it compiles a model for every column of the Jacobian and applies
commands open-loop, without the servos' torque limit and friction.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pixel2catch.identification.fit_problem import Directions, FitCfg, Point
from pixel2catch.identification.fit_simulation import FIT_DT, RecordedMotion
from pixel2catch.identification.fit_squares import (
    Errors,
    Problem,
    Slopes,
    correlation_time,
    information,
)
from pixel2catch.identification.recording import Recording
from pixel2catch.robot.joint_dynamics import JointDynamics

LAG_PARAMETERS = ("damping", "filter_lookahead", "latency")
"""What is fitted first, alone: else an unexplained lag drives the armature into a far, wrong minimum."""

COARSENESS = 2.0
"""Length of the time steps with which a fit begins, in those with which it ends. Source: ours."""

COARSE_ROUNDS = 2
"""Evaluations of slopes with these. Source: ours."""

ROUGH = 0.03
"""Share of the squares that is worth a step while only the lag moves. Source: ours."""

FINE = 0.2
"""Step that is worth to be taken, in standard errors of what is fitted. Source: ours."""

MAX_STEPS = 6
"""Steps under the same slopes. Source: ours; each is about a fifth of the one before, or of no use."""

CAUTIONS = (0.0, 0.1, 10.0)
"""Marquardt's factors; of their steps, all tried at once, the best is taken. Source: ours."""

Report = Callable[[str], None]


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


def fit_dynamics(
    recordings: Sequence[Recording], start: JointDynamics, cfg: FitCfg, report: Report = lambda _: None
) -> Fit:
    """Fit the free parameters of every joint to the recordings.

    Args:
        recordings: What to fit; hold whole recordings out to judge the result with `tracking_error`.
        start: Start values, and the values of what is not free.
        cfg: How to fit.
        report: Told how far it is.

    Raises:
        RecordingError: There is no recording, one is too short, or they are of different joints.
        InvalidValueError: The start is of other joints, or has no filter where one is to be fitted.
    """
    coarse = Problem(recordings, start, replace(cfg, physics_dt=COARSENESS * cfg.physics_dt), report)
    point = coarse.start
    if set(LAG_PARAMETERS) & set(cfg.free):
        lag = coarse.coordinates.directions(LAG_PARAMETERS, is_coupled=False)
        point, _ = _followed(coarse, point, coarse.slopes(point, lag), ROUGH)
    directions = coarse.coordinates.directions(cfg.free, is_coupled=True)
    point, _ = _solved(coarse, point, directions, COARSE_ROUNDS)
    fine = Problem(recordings, start, cfg, report)
    point, slopes = _solved(fine, point, directions, cfg.max_rounds)
    weight = information(slopes.errors) / correlation_time(slopes.errors)
    return Fit(
        dynamics=fine.coordinates.dynamics(point),
        free=cfg.free,
        covariance=fine.quadratic(point, slopes, weight).covariance,
        prior=cfg.prior,
        residual=slopes.errors,
    )


def _solved(problem: Problem, point: Point, directions: Directions, max_rounds: int) -> tuple[Point, Slopes]:
    """Move along some directions to where the squares are least; the point, errors and slopes there.

    Slopes take many simulations, so that they are followed as far as they lead.
    """
    slopes = problem.slopes(point, directions)
    for _ in range(max_rounds - 1):
        followed, _ = _followed(problem, point, slopes)
        if (followed == point).all():
            return point, slopes
        point, slopes = followed, problem.slopes(followed, directions)
    point, errors = _followed(problem, point, slopes)
    return point, replace(slopes, errors=errors)


def _followed(
    problem: Problem, point: Point, slopes: Slopes, least_share: float = 0.0
) -> tuple[Point, Errors]:
    """Take steps under the same slopes while they are worth it and lessen the squares."""
    errors = slopes.errors
    for _ in range(MAX_STEPS):
        weight = information(errors)
        squares = problem.squares(point, errors, weight)
        quadratic = problem.quadratic(point, replace(slopes, errors=errors), weight)
        noise = correlation_time(errors).mean() * len(quadratic.gradient)
        if quadratic.decrease < max(FINE**2 * noise, least_share * squares):
            break
        points = [problem.coordinates.bounded(point + quadratic.step(caution)) for caution in CAUTIONS]
        tried = problem.errors(points)
        results = [problem.squares(*pair, weight) for pair in zip(points, tried, strict=True)]
        best = int(np.argmin(results))
        if results[best] >= squares:
            break
        point, errors = points[best], tried[best]
        problem.report(errors)
    return point, errors


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
