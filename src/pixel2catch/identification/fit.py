"""Fit the joint dynamics under which the simulation moves as the robot did.

Least squares on positions, in logarithms of the parameters (the latency in units of 10 ms). A broad prior
about the start holds what the recordings do not determine. Not `mujoco.sysid`: it applies commands open-loop,
without the servos' torque limit and friction. Not `scipy.optimize.least_squares`: a Jacobian takes many
simulations, so it is used for several steps, and directions of different joints share one simulation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.signal import detrend

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification import intervals
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import FIT_DT, Encoders, RecordedMotion
from pixel2catch.robots.joint_dynamics import PARAMETERS, SERVOJ_GAIN, SERVOJ_LOOKAHEAD, JointDynamics

SCALE = ("stiffness", "damping", "frictionloss", "armature")
"""Parameters that are torques over motion: positions alone leave their common scale open."""

SERVO_PARAMETERS = (*SCALE, "latency")  # fitted where commands reach the servo unfiltered
FILTER_PARAMETERS = ("filter_gain", "filter_lookahead", "latency")  # fitted in front of a known servo

LAG_PARAMETERS = ("damping", "filter_lookahead", "latency")
"""Fitted first, alone: else an unexplained lag drives the armature into a far, wrong minimum."""

LATENCY_UNIT = 0.01  # latency that counts as much as a factor e of another parameter [s] (ours)
PRIOR = 2.0  # standard deviation of the prior, in coordinates of the fit: a factor 7 (ours)
MAX_FACTOR = 1e3  # largest factor between the start and the result of any other parameter (ours)
LEAST_VALUE = 1e-9  # stands for 0 where the fit needs a logarithm
MAX_ROUNDS = 4  # most evaluations of the Jacobian with the final time step (ours)
COARSENESS = 2.0  # time step at the beginning of a fit over the final one (ours)
COARSE_ROUNDS = 2  # evaluations of the Jacobian with that time step (ours)
COARSE = 0.01  # least decrease of a coarse step, as a share of the squares (ours)
ROUGH = 0.03  # least decrease of a step while only the lag moves, as a share of the squares (ours)
OUTLYING = 4.0  # residual that counts half, in mean absolute ones (ours; lost commands are far beyond)
FINE = 2e-4  # least decrease of a step with the final time step, as a share of the squares (ours)
MAX_STEP = 1.0  # longest step of a coordinate (ours; farther away the Jacobian is different)
MAX_STEPS = 3  # most steps with one Jacobian (ours; each is about a fifth of the one before, or useless)
DAMPINGS = (0.0, 0.1, 10.0)  # Marquardt's factors; their steps are tried at once, the best is taken (ours)

LINEAR = {"latency": (LATENCY_UNIT, 0.0, 0.2), "play": (1e-3, 0.0, 0.05), "drift": (2e-4, -5e-3, 5e-3)}
"""Parameters that are fitted without a logarithm: the unit that counts as a factor e of others, least and
largest value. Latency [s], play of an encoder [rad], drift of the clocks. Source: ours; crystals drift by
at most 1e-4, clocks that are just being set by 5e-4."""

CLOCKS = ("latency", "drift")  # the joints of a group share them: their messages come together
DIFFERENCE = 1e-2  # step of the finite differences (ours; above the kinks of a torque limit)
LEAST_RESIDUAL = 1e-6  # least size of residuals in weights [rad] (ours, far below the noise of encoders)
Point = Float[np.ndarray, "num_joints num_columns"]
Residuals = Float[np.ndarray, "num_settled num_joints"]
Weight = Float[np.ndarray, "num_settled num_joints"]
Report = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class FitCfg:
    """What is fitted, and the time step."""

    free: tuple[str, ...] = SERVO_PARAMETERS  #: parameters that are fitted; others keep their start values
    physics_dt: float = FIT_DT  #: time step of the simulation [s]

    def __post_init__(self) -> None:
        for name in self.free:
            if name not in PARAMETERS:
                raise UnknownNameError("parameter", name, PARAMETERS)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A fit and how well the recordings determine it."""

    dynamics: JointDynamics  #: the fitted dynamics
    free: tuple[str, ...]  #: the parameters that were fitted
    #: of each joint's free parameters, in the coordinates of the fit, with prior and errors of the model
    covariance: Float[np.ndarray, "num_joints num_free num_free"]
    encoders: Encoders  #: fitted play and zeros, and drift of the clocks
    encoder_deviations: Encoders  #: standard deviations of play and drift


def fit_dynamics(
    recordings: Sequence[Recording], start: JointDynamics, cfg: FitCfg, report: Report = lambda _: None
) -> Fit:
    """Fit the free parameters of every joint to recordings; `start` also has the other parameters.

    Raises RecordingError for no or short recordings or different joints, InvalidValueError if `start` has
    other joints, or no filter where one is to be fitted.
    """
    coarse = _Problem(recordings, start, replace(cfg, physics_dt=COARSENESS * cfg.physics_dt), report)
    point = coarse.start
    if set(LAG_PARAMETERS) & set(cfg.free):
        lag = coarse.directions(LAG_PARAMETERS, is_coupled=False)
        point, _ = _followed(coarse, point, coarse.jacobian(point, lag), ROUGH)
    directions = coarse.directions(coarse.names, is_coupled=True)
    point, _ = _solved(coarse, point, directions, COARSE_ROUNDS, COARSE)
    fine = _Problem(recordings, start, cfg, report)
    point, jacobian = _solved(fine, point, directions, MAX_ROUNDS, FINE)
    covariance, num = fine.covariance(point, jacobian), len(cfg.free)
    deviations = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) * fine.unit
    return Fit(
        dynamics=fine.dynamics(point),
        free=cfg.free,
        covariance=covariance[:, :num, :num],
        encoders=fine.with_zeros(fine.encoders(point * fine.unit), point),
        encoder_deviations=fine.encoders(deviations),
    )


@dataclass(frozen=True, kw_only=True)
class Directions:
    """Directions in which a point can move."""

    steps: Float[np.ndarray, "num_directions num_joints num_free"]  #: a unit step of each
    affected: Bool[np.ndarray, "num_directions num_joints"]  #: joints whose motion each changes

    def batches(self) -> list[list[int]]:
        """Return the directions by number, in batches of which none affects a joint twice."""
        batches: list[list[int]] = []
        for number, joints in enumerate(self.affected):
            fitting = [batch for batch in batches if not (self.affected[batch] & joints).any()]
            batches += [] if fitting else [[]]
            next(iter(fitting), batches[-1]).append(number)
        return batches


@dataclass(frozen=True, kw_only=True)
class Jacobian:
    """Derivatives of the simulated positions at a point."""

    residuals: Residuals  #: simulated minus measured positions at the point [rad]
    directions: Directions  #: the directions of the derivatives
    #: change of the positions in simulations that move several directions each
    changes: Float[np.ndarray, "num_simulations num_settled num_joints"]
    source: Int[np.ndarray, " num_directions"]  #: the simulation that moved each direction


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """The squares about a point, as a quadratic function of the coordinates of some directions."""

    directions: Directions
    hessian: Float[np.ndarray, "num_directions num_directions"]  #: half the curvature: an inverse covariance
    gradient: Float[np.ndarray, " num_directions"]  #: half of the derivatives

    def step(self, damping: float) -> Point:
        """Return the step to the least squares; Marquardt's damping makes it shorter and steeper."""
        matrix = self.hessian + damping * np.diag(np.diagonal(self.hessian))
        step = -np.linalg.solve(matrix, self.gradient)
        return np.tensordot(step.clip(-MAX_STEP, MAX_STEP), self.directions.steps, axes=1)

    @property
    def decrease(self) -> float:
        """Return the predicted decrease of the sum of squares by a step without damping and clipping."""
        return float(self.gradient @ np.linalg.solve(self.hessian, self.gradient))


class _Problem:
    """The distance of simulation from recordings, at points: one row of free parameters per joint."""

    def __init__(
        self, recordings: Sequence[Recording], start: JointDynamics, cfg: FitCfg, report: Report
    ) -> None:
        """Prepare the simulation; arguments and errors are those of `fit_dynamics`."""
        self._recordings, self._motion = recordings, RecordedMotion(recordings, cfg.physics_dt)
        if self._motion.joints != start.joints:
            pair = f"the recordings are of {self._motion.joints}, the start is of {start.joints}"
            raise InvalidValueError(f"{pair}; select the same joints in both.")
        if {"filter_gain", "filter_lookahead"} & set(cfg.free) and not start.has_filter.all():
            values = f"filter_gain={SERVOJ_GAIN:g} and filter_lookahead={SERVOJ_LOOKAHEAD:g} of servoJ"
            raise InvalidValueError(f"the start has no command filter to be fitted; start with {values}.")
        self._measured = self._motion.measured
        self._dynamics, self._cfg, self._report = start, cfg, report
        self.names = (*cfg.free, "play", *("drift" for _ in recordings))
        self.num_free, self._is_linear = len(cfg.free), np.array([name in LINEAR for name in self.names])
        linear = [LINEAR.get(name, (1.0, 0.0, 0.0)) for name in self.names]
        self.unit, self._lower, self._upper = np.array(linear).T
        values = np.stack([getattr(start, name) for name in cfg.free], axis=-1)
        values = np.pad(values, ((0, 0), (0, len(self.names) - self.num_free)))
        logarithms = np.log(np.maximum(values, LEAST_VALUE))
        self.start = np.where(self._is_linear, values / self.unit, logarithms)

    def dynamics(self, point: Point) -> JointDynamics:
        with np.errstate(over="ignore"):  # columns that are linear are no exponents
            values = np.where(self._is_linear, point * self.unit, np.exp(point))
        columns = {name: values[:, i].copy() for i, name in enumerate(self._cfg.free)}
        return self._dynamics.with_values(**columns)

    def encoders(self, values: Point) -> Encoders:
        """Return the encoders' part of values: the play of each joint, then the drift in each recording."""
        play, *drift = values[:, self.num_free :].T.copy()
        return Encoders(play=play, drift=np.stack(drift), zero=np.zeros((len(drift), len(play))))

    def bounded(self, point: Point) -> Point:
        """Return the nearest point within the bounds of the fit."""
        width = np.log(MAX_FACTOR)
        lower = np.where(self._is_linear, self._lower / self.unit, self.start - width)
        upper = np.where(self._is_linear, self._upper / self.unit, self.start + width)
        return point.clip(lower, upper)

    def directions(self, names: Sequence[str], is_coupled: bool) -> Directions:
        """Return the directions in which some of the parameters can move.

        The joints of a group share the change of latency. All torques over motion move with the stiffness:
        differences of large derivatives would not determine their common scale. Coupled directions also
        affect the joints that the motion of a joint moves.
        """
        groups, coupled = self._motion.groups, self._motion.coupled
        together = groups == np.array(list(dict.fromkeys(groups)))[:, None]
        steps, affected = [], []
        for column, name in enumerate(self.names):
            along = np.arange(len(self.names)) == column
            if name == "stiffness":
                along = np.isin(self.names, SCALE) & np.isin(self.names, names)
            moved = together if name in CLOCKS else np.eye(len(groups), dtype=bool)
            for joints in moved if name in names else ():
                steps.append(np.outer(joints, along).astype(float))
                is_moving_others = is_coupled and column < self.num_free
                affected.append(coupled[joints].any(axis=0) if is_moving_others else joints)
        return Directions(steps=np.array(steps), affected=np.array(affected))

    def covariance(
        self, point: Point, jacobian: Jacobian
    ) -> Float[np.ndarray, "num_joints num_columns num_columns"]:
        """Return the covariance of each joint's row of a fitted point."""
        weight, starts = _information(jacobian.residuals), self._motion.block_starts(intervals.BLOCK)
        equations = self.normal_equations(point, jacobian, weight)
        scores = np.zeros((len(starts), len(equations.hessian)))
        for j, is_affected in enumerate(jacobian.directions.affected.T):
            moving = np.flatnonzero(is_affected)
            columns = jacobian.changes[jacobian.source[moving], :, j]
            added = columns * (weight[:, j] * jacobian.residuals[:, j])
            scores[:, moving] += np.add.reduceat(added, starts, axis=1).T
        steps = jacobian.directions.steps
        of_steps = intervals.block_covariance(equations.hessian, scores)
        covariance = np.einsum("kja,kl,ljb->jab", steps, of_steps, steps)
        dynamics, num = self.dynamics(point), self.num_free
        inertias = self._dynamics.armature, self._motion.link_inertia
        motions = [(np.diff(each.q, axis=0), np.diff(each.t_meas)[:, None]) for each in self._recordings]
        speed = np.sqrt(np.mean([np.mean((q / time) ** 2, axis=0) for q, time in motions], axis=0))
        covariance[:, :num, :num] += intervals.model_covariance(
            dynamics, *inertias, speed, self._cfg.free, LATENCY_UNIT
        )
        seconds = [np.ptp(recording.t_meas) for recording in self._recordings]
        # A joint that turns around rests until its command moved by the play and 2 frictionloss / stiffness.
        play = 2.0 * intervals.FRICTION_DEVIATION * dynamics.frictionloss / dynamics.stiffness
        lag = intervals.lag_deviation(dynamics, speed) * dynamics.damping / dynamics.stiffness
        beside = [play, *(np.hypot(intervals.LATENCY_DEVIATION, lag) / length for length in seconds)]
        for column, deviation in enumerate(beside, start=num):
            covariance[:, column, column] += (deviation / self.unit[column]) ** 2
        return covariance

    def report(self, residuals: Residuals) -> None:
        size = 1e3 * np.sqrt(np.mean(residuals**2))
        self._report(f"fitting at {1.0 / self._cfg.physics_dt:.0f} Hz, {size:.3f} mrad")

    def residuals(self, points: Sequence[Point]) -> Float[np.ndarray, "num_points num_settled num_joints"]:
        """Return simulated minus measured positions [rad], without the encoders' zeros, which drift."""
        dynamics = [self.dynamics(point) for point in points]
        encoders = [self.encoders(point * self.unit) for point in points]
        residuals = self._motion.simulate(dynamics, encoders) - self._measured
        for part in self._motion.split(residuals):
            part[:] = detrend(part, axis=1)
        return residuals

    def with_zeros(self, encoders: Encoders, point: Point) -> Encoders:
        """Return encoders whose zeros are what is measured beside the simulation at a fitted point."""
        (simulated,) = self._motion.simulate([self.dynamics(point)], [encoders])
        parts = self._motion.split(self._measured - simulated)
        return replace(encoders, zero=np.stack([part.mean(axis=0) for part in parts]))

    def squares(self, point: Point, residuals: Residuals, weight: Weight) -> float:
        """Return the weighted squares of the residuals, and of the distance from the start over the prior."""
        distance = (point - self.start) / PRIOR
        return float((weight * residuals**2).sum() + (distance**2).sum())

    def jacobian(self, point: Point, directions: Directions) -> Jacobian:
        """Return how the positions change about a point; directions of different joints move at once."""
        batches = directions.batches()
        shifts = [directions.steps[batch].sum(axis=0) for batch in batches]
        base, *shifted = self.residuals([point, *(point + DIFFERENCE * shift for shift in shifts)])
        source = np.zeros(len(directions.steps), dtype=int)
        for i, batch in enumerate(batches):
            source[batch] = i
        changes = (np.stack(shifted) - base) / DIFFERENCE
        return Jacobian(residuals=base, directions=directions, changes=changes, source=source)

    def normal_equations(self, point: Point, jacobian: Jacobian, weight: Weight) -> NormalEquations:
        """Return those of `squares`, without directions in which a bound blocks the gradient."""
        directions, distance = jacobian.directions, point - self.start
        steps = directions.steps
        hessian = np.einsum("kja,lja->kl", steps, steps) / PRIOR**2
        gradient = np.einsum("kja,ja->k", steps, distance) / PRIOR**2
        for j, is_affected in enumerate(directions.affected.T):
            moving = np.flatnonzero(is_affected)
            columns = jacobian.changes[jacobian.source[moving], :, j]
            weighted = weight[:, j] * columns
            hessian[np.ix_(moving, moving)] += weighted @ columns.T
            gradient[moving] += weighted @ jacobian.residuals[:, j]
        ways = -np.sign(gradient)[:, None, None] * steps
        is_free = np.array([(self.bounded(point + LEAST_VALUE * way) != point).any() for way in ways])
        hessian = np.where(np.outer(is_free, is_free), hessian, np.diag(np.diagonal(hessian)))
        return NormalEquations(directions=directions, hessian=hessian, gradient=gradient * is_free)


def _solved(
    problem: _Problem, point: Point, directions: Directions, max_rounds: int, least_share: float
) -> tuple[Point, Jacobian]:
    """Move along some directions to the least squares; return the point and the Jacobian there."""
    jacobian = problem.jacobian(point, directions)
    for _ in range(max_rounds - 1):
        followed, _ = _followed(problem, point, jacobian, least_share)
        if (followed == point).all():
            return point, jacobian
        point, jacobian = followed, problem.jacobian(followed, directions)
    point, residuals = _followed(problem, point, jacobian, least_share)
    return point, replace(jacobian, residuals=residuals)


def _followed(
    problem: _Problem, point: Point, jacobian: Jacobian, least_share: float
) -> tuple[Point, Residuals]:
    """Take steps with the same Jacobian while they lessen the squares enough."""
    residuals = jacobian.residuals
    for _ in range(MAX_STEPS):
        weight = _information(residuals)
        squares = problem.squares(point, residuals, weight)
        equations = problem.normal_equations(point, replace(jacobian, residuals=residuals), weight)
        if equations.decrease < least_share * squares:
            break
        points = [problem.bounded(point + equations.step(damping)) for damping in DAMPINGS]
        tried = problem.residuals(points)
        results = [problem.squares(*pair, weight) for pair in zip(points, tried, strict=True)]
        best = int(np.argmin(results))
        if results[best] >= squares:
            break
        point, residuals = points[best], tried[best]
        problem.report(residuals)
    return point, residuals


def _information(residuals: Residuals) -> Weight:
    """Return the weight of each residual's square [1/rad²]: one over their mean square, less for outliers.

    These are the weights of Cauchy's distribution: a command that was lost counts little.
    """
    scale = OUTLYING * np.mean(np.abs(residuals), axis=0)
    share = 1.0 / (1.0 + (residuals / np.maximum(scale, LEAST_RESIDUAL)) ** 2)
    square = (share * residuals**2).sum(axis=0) / share.sum(axis=0)
    return share / np.maximum(square, LEAST_RESIDUAL**2)
