"""The least squares of the fit: how far simulation is from recordings, and which way is less."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pixel2catch.errors import InvalidValueError
from pixel2catch.identification.fit_problem import LEAST_VALUE, Coordinates, Directions, FitCfg, Point
from pixel2catch.identification.fit_simulation import RecordedMotion
from pixel2catch.identification.recording import Recording
from pixel2catch.robot.joint_dynamics import JointDynamics

MAX_STEP = 1.0
"""Longest step of a coordinate. Source: ours; farther away motion is another."""

DIFFERENCE = 1e-2
"""Step of the finite differences, in the coordinates of the fit. Source: ours; much less than a 95 % interval
of what is worth fitting, and more than the kinks that a torque limit makes."""

LEAST_ERROR = 1e-6
"""Errors count as at least so large [rad]. Source: ours, two orders below the noise of encoders."""

Errors = Float[np.ndarray, "num_settled num_joints"]

Weight = Float[np.ndarray, " num_joints"]


@dataclass(frozen=True, kw_only=True)
class Quadratic:
    """The squares about a point, as a quadratic function of the coordinates of some directions.

    Attributes:
        directions: What moves.
        hessian: Half of the second derivatives: the inverse of a covariance.
        gradient: Half of the derivatives.
    """

    directions: Directions
    hessian: Float[np.ndarray, "num_directions num_directions"]
    gradient: Float[np.ndarray, " num_directions"]

    def within(self, coordinates: Coordinates, point: Point) -> "Quadratic":
        """The same without the directions in which bounds forbid to follow the gradient."""
        ways = -np.sign(self.gradient)[:, None, None] * self.directions.steps
        is_free = np.array([(coordinates.bounded(point + LEAST_VALUE * way) != point).any() for way in ways])
        hessian = np.where(np.outer(is_free, is_free), self.hessian, np.diag(np.diagonal(self.hessian)))
        return replace(self, hessian=hessian, gradient=self.gradient * is_free)

    def step(self, caution: float) -> Point:
        """The step to the least squares; caution, as Marquardt's, makes it shorter and steeper."""
        matrix = self.hessian + caution * np.diag(np.diagonal(self.hessian))
        step = -np.linalg.solve(matrix, self.gradient)
        return np.tensordot(step.clip(-MAX_STEP, MAX_STEP), self.directions.steps, axes=1)

    @property
    def decrease(self) -> float:
        """By how much the squares would become less without caution, if they were quadratic."""
        return float(self.gradient @ np.linalg.solve(self.hessian, self.gradient))

    @property
    def covariance(self) -> Float[np.ndarray, "num_joints num_free num_free"]:
        """Covariance of each joint's parameters, with those of the other joints unknown as well."""
        steps = self.directions.steps
        return np.einsum("kja,kl,ljb->jab", steps, np.linalg.inv(self.hessian), steps)


@dataclass(frozen=True, kw_only=True)
class Slopes:
    """Derivatives of the simulated positions at a point.

    Attributes:
        errors: Simulated minus measured positions at the point [rad].
        directions: What moves.
        changes: Change of the positions in each of some simulations, in which several directions moved.
        source: In which of these each direction moved.
    """

    errors: Errors
    directions: Directions
    changes: Float[np.ndarray, "num_simulations num_settled num_joints"]
    source: Int[np.ndarray, " num_directions"]

    def quadratic(self, distance: Point, prior: float, weight: Weight) -> Quadratic:
        """The weighted squares about the point, and those of its distance from the start over the prior."""
        steps = self.directions.steps
        hessian = np.einsum("kja,lja->kl", steps, steps) / prior**2
        gradient = np.einsum("kja,ja->k", steps, distance) / prior**2
        for j, is_felt in enumerate(self.directions.felt_by.T):
            moving = np.flatnonzero(is_felt)
            columns = self.changes[self.source[moving], :, j]
            hessian[np.ix_(moving, moving)] += weight[j] * columns @ columns.T
            gradient[moving] += weight[j] * columns @ self.errors[:, j]
        return Quadratic(directions=self.directions, hessian=hessian, gradient=gradient)


class Problem:
    """How far simulation is from some recordings, at points in the coordinates of a fit."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        start: JointDynamics,
        cfg: FitCfg,
        report: Callable[[str], None],
    ) -> None:
        """Prepare the simulation.

        Args:
            recordings: What to fit.
            start: Start values, and the values of what is not free.
            cfg: What is free, and the time step.
            report: Told how far the fit is.

        Raises:
            RecordingError: There is no recording, one is too short, or they are of different joints.
            InvalidValueError: The start is of other joints, or has no filter where one is to be fitted.
        """
        self._motion = RecordedMotion(recordings, cfg.physics_dt)
        if self._motion.joints != start.joints:
            raise InvalidValueError(
                f"the recordings are of {self._motion.joints}, the start is of {start.joints}; "
                "select the same joints in both."
            )
        self.coordinates = Coordinates(start, cfg.free)
        self.start = self.coordinates.of(start)
        self._measured = self._motion.measured
        self._cfg = cfg
        self._report = report

    def report(self, errors: Errors) -> None:
        """Tell how far the fit is."""
        size = 1e3 * np.sqrt(np.mean(errors**2))
        self._report(f"fitting at {1.0 / self._cfg.physics_dt:.0f} Hz, {size:.3f} mrad")

    def errors(self, points: Sequence[Point]) -> Float[np.ndarray, "num_points num_settled num_joints"]:
        """Simulated minus measured positions [rad]."""
        return self._motion.simulate([self.coordinates.dynamics(point) for point in points]) - self._measured

    def squares(self, point: Point, errors: Errors, weight: Weight) -> float:
        """Weighted squares of the errors, and of the distance from the start over the prior."""
        distance = (point - self.start) / self._cfg.prior
        return float((errors**2).sum(axis=0) @ weight + (distance**2).sum())

    def quadratic(self, point: Point, slopes: Slopes, weight: Weight) -> Quadratic:
        """The squares about the point of the slopes, within the bounds."""
        quadratic = slopes.quadratic(point - self.start, self._cfg.prior, weight)
        return quadratic.within(self.coordinates, point)

    def slopes(self, point: Point, directions: Directions) -> Slopes:
        """How the positions change about a point; what moves different joints moves at once."""
        batches = directions.together()
        shifts = [directions.steps[batch].sum(axis=0) for batch in batches]
        base, *shifted = self.errors([point, *(point + DIFFERENCE * shift for shift in shifts)])
        source = np.zeros(len(directions.steps), dtype=int)
        for i, batch in enumerate(batches):
            source[batch] = i
        changes = (np.stack(shifted) - base) / DIFFERENCE
        return Slopes(errors=base, directions=directions, changes=changes, source=source)


def information(errors: Errors) -> Weight:
    """What a square of each joint's errors weighs [1/rad²]: one over their mean square."""
    return 1.0 / np.maximum(np.mean(errors**2, axis=0), LEAST_ERROR**2)


def correlation_time(errors: Errors) -> Weight:
    """How many consecutive samples tell one independent thing: 1 for white noise, more for model errors.

    It is 1 plus twice the sum of the autocorrelations up to the first that is not positive.
    """
    centered = errors - errors.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(centered, n=2 * len(errors), axis=0)) ** 2
    correlation = np.fft.irfft(spectrum, axis=0)[: len(errors)]
    correlation = correlation / np.maximum(correlation[0], np.finfo(float).tiny)
    is_before = np.cumprod(correlation > 0.0, axis=0)
    return np.maximum(2.0 * (correlation * is_before).sum(axis=0) - 1.0, 1.0)
