"""The fit: the joint dynamics under which simulation moves as the robot did.

Least squares on positions, in logarithms of the parameters (the latency in units of 10 ms), so that every
parameter has a natural scale and stays positive. A broad prior about the start keeps in place what the
recordings do not tell. Not `mujoco.sysid`: it compiles a model for every column of the Jacobian and applies
commands open-loop, without the servos' torque limit and friction. Not `scipy.optimize.least_squares`: a
Jacobian takes many simulations, so that it is used for several steps, and what moves different joints shares
one simulation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import FIT_DT, RecordedMotion
from pixel2catch.robots.joint_dynamics import PARAMETERS, SERVOJ_GAIN, SERVOJ_LOOKAHEAD, JointDynamics

SERVO_PARAMETERS = ("stiffness", "damping", "frictionloss", "armature", "latency")
"""What is fitted where commands reach the servo unfiltered."""

FILTER_PARAMETERS = ("filter_gain", "filter_lookahead", "latency")
"""What is fitted of the command path in front of a servo that is known."""

SCALE = ("stiffness", "damping", "frictionloss", "armature")
"""Parameters that are all torques over motion: positions alone leave their common scale open."""

LAG_PARAMETERS = ("damping", "filter_lookahead", "latency")
"""What is fitted first, alone: else an unexplained lag drives the armature into a far, wrong minimum."""

LATENCY_UNIT = 0.01  # latency that counts as much as a factor e of another parameter [s] (ours)
MAX_LATENCY = 0.2  # largest latency that a fit tries [s] (ours)
MAX_FACTOR = 1e3  # largest factor between the start and the result of any other parameter (ours)
LEAST_VALUE = 1e-9  # what a fit takes for 0 where it needs a logarithm
COARSENESS = 2.0  # length of the time steps with which a fit begins, in those with which it ends (ours)
COARSE_ROUNDS = 2  # evaluations of the Jacobian with these (ours)
ROUGH = 0.03  # share of the squares that is worth a step while only the lag moves (ours)
FINE = 0.2  # step that is worth to be taken, in standard errors of what is fitted (ours)
MAX_STEPS = 6  # steps under one Jacobian (ours; each is about a fifth of the one before, or of no use)
MAX_STEP = 1.0  # longest step of a coordinate (ours; farther away motion is another)
DAMPINGS = (0.0, 0.1, 10.0)  # Marquardt's factors; of their steps, tried at once, the best is taken (ours)

DIFFERENCE = 1e-2
"""Step of the finite differences, in the coordinates of the fit. Source: ours; much less than a 95 % interval
of what is worth fitting, and more than the kinks that a torque limit makes."""

LEAST_RESIDUAL = 1e-6  # residuals count as at least so large [rad] (ours, far below the noise of encoders)
Point = Float[np.ndarray, "num_joints num_free"]
Residuals = Float[np.ndarray, "num_settled num_joints"]
Weight = Float[np.ndarray, " num_joints"]
Report = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class FitCfg:
    """How the dynamics are fitted."""

    free: tuple[str, ...] = SERVO_PARAMETERS  #: what is fitted; other parameters keep their start values
    prior: float = 2.0  #: deviation of what is known before, in coordinates of the fit: 2 is a factor 7
    physics_dt: float = FIT_DT  #: time step of the simulation [s]
    max_rounds: int = 4  #: most evaluations of the Jacobian with this time step

    def __post_init__(self) -> None:
        """Refuse unknown parameters, none at all, and sizes that are not positive."""
        for name in self.free:
            if name not in PARAMETERS:
                raise UnknownNameError("parameter", name, PARAMETERS)
        if not self.free:
            raise InvalidValueError(f"nothing is free to be fitted; name some of {', '.join(PARAMETERS)}")
        for name in ("prior", "physics_dt", "max_rounds"):
            if not getattr(self, name) > 0:
                raise InvalidValueError(f"{name} is {getattr(self, name):g}; it must be more than 0")


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A fit and how well its recordings determine it."""

    dynamics: JointDynamics  #: the fitted dynamics
    free: tuple[str, ...]  #: the parameters that were fitted
    #: of each joint's free parameters, in the coordinates of the fit; the prior is in it
    covariance: Float[np.ndarray, "num_joints num_free num_free"]
    prior: float  #: standard deviation of the prior: where it is not reduced, the recordings tell nothing


def fit_dynamics(
    recordings: Sequence[Recording], start: JointDynamics, cfg: FitCfg, report: Report = lambda _: None
) -> Fit:
    """Fit the free parameters of every joint to recordings; hold whole ones out to judge the result.

    The start has also the values of what is not free. Reports how far the fit is.

    Raises:
        RecordingError: There is no recording, one is too short, or they are of different joints.
        InvalidValueError: The start is of other joints, or has no filter where one is to be fitted.
    """
    coarse = _Problem(recordings, start, replace(cfg, physics_dt=COARSENESS * cfg.physics_dt), report)
    point = coarse.start
    if set(LAG_PARAMETERS) & set(cfg.free):
        lag = coarse.directions(LAG_PARAMETERS, is_coupled=False)
        point, _ = _followed(coarse, point, coarse.jacobian(point, lag), ROUGH)
    directions = coarse.directions(cfg.free, is_coupled=True)
    point, _ = _solved(coarse, point, directions, COARSE_ROUNDS)
    fine = _Problem(recordings, start, cfg, report)
    point, jacobian = _solved(fine, point, directions, cfg.max_rounds)
    weight = _information(jacobian.residuals) / correlation_time(jacobian.residuals)
    return Fit(
        dynamics=fine.dynamics(point),
        free=cfg.free,
        covariance=fine.normal_equations(point, jacobian, weight).covariance,
        prior=cfg.prior,
    )


@dataclass(frozen=True, kw_only=True)
class Directions:
    """Ways in which a point can move."""

    steps: Float[np.ndarray, "num_directions num_joints num_free"]  #: a unit step of each
    felt_by: Bool[np.ndarray, "num_directions num_joints"]  #: which joints move otherwise then

    def together(self) -> list[list[int]]:
        """Directions by number, in batches that no joint feels more than one of."""
        batches: list[list[int]] = []
        for number, joints in enumerate(self.felt_by):
            fitting = (batch for batch in batches if not (self.felt_by[batch] & joints).any())
            batch = next(fitting, None)
            if batch is None:
                batches.append([number])
            else:
                batch.append(number)
        return batches


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """The squares about a point, as a quadratic function of the coordinates of some directions."""

    directions: Directions  #: what moves
    hessian: Float[np.ndarray, "num_directions num_directions"]  #: half the curvature: an inverse covariance
    gradient: Float[np.ndarray, " num_directions"]  #: half of the derivatives

    def step(self, damping: float) -> Point:
        """The step to the least squares; damping, as Marquardt's, makes it shorter and steeper."""
        matrix = self.hessian + damping * np.diag(np.diagonal(self.hessian))
        step = -np.linalg.solve(matrix, self.gradient)
        return np.tensordot(step.clip(-MAX_STEP, MAX_STEP), self.directions.steps, axes=1)

    @property
    def decrease(self) -> float:
        """By how much the squares would become less without damping, if they were quadratic."""
        return float(self.gradient @ np.linalg.solve(self.hessian, self.gradient))

    @property
    def covariance(self) -> Float[np.ndarray, "num_joints num_free num_free"]:
        """Covariance of each joint's parameters, with those of the other joints unknown as well."""
        steps = self.directions.steps
        return np.einsum("kja,kl,ljb->jab", steps, np.linalg.inv(self.hessian), steps)


@dataclass(frozen=True, kw_only=True)
class Jacobian:
    """Derivatives of the simulated positions at a point."""

    residuals: Residuals  #: simulated minus measured positions at the point [rad]
    directions: Directions  #: what moves
    #: change of the positions in each of some simulations, in which several directions moved
    changes: Float[np.ndarray, "num_simulations num_settled num_joints"]
    source: Int[np.ndarray, " num_directions"]  #: in which of these each direction moved


class _Problem:
    """How far simulation is from some recordings, at points: one row of free parameters per joint."""

    def __init__(
        self, recordings: Sequence[Recording], start: JointDynamics, cfg: FitCfg, report: Report
    ) -> None:
        """Prepare the simulation; arguments and errors are those of `fit_dynamics`."""
        self._motion = RecordedMotion(recordings, cfg.physics_dt)
        if self._motion.joints != start.joints:
            raise InvalidValueError(
                f"the recordings are of {self._motion.joints}, the start is of {start.joints}; "
                "select the same joints in both."
            )
        if {"filter_gain", "filter_lookahead"} & set(cfg.free) and not start.has_filter.all():
            raise InvalidValueError(
                "the command filter is to be fitted, but the start has none; "
                f"start with filter_gain={SERVOJ_GAIN:g} and filter_lookahead={SERVOJ_LOOKAHEAD:g}, "
                "the settings of servoJ."
            )
        self._measured = self._motion.measured
        self._dynamics, self._cfg, self._report = start, cfg, report
        self._is_latency = np.array([name == "latency" for name in cfg.free])
        values = np.stack([getattr(start, name) for name in cfg.free], axis=-1)
        logarithms = np.log(np.maximum(values, LEAST_VALUE))
        self.start = np.where(self._is_latency, values / LATENCY_UNIT, logarithms)

    def dynamics(self, point: Point) -> JointDynamics:
        with np.errstate(over="ignore"):  # a latency is no exponent
            values = np.where(self._is_latency, point * LATENCY_UNIT, np.exp(point))
        columns = {name: values[:, i].copy() for i, name in enumerate(self._cfg.free)}
        return self._dynamics.with_values(**columns)

    def bounded(self, point: Point) -> Point:
        """The nearest point that a fit may try."""
        width = np.log(MAX_FACTOR)
        lower = np.where(self._is_latency, 0.0, self.start - width)
        upper = np.where(self._is_latency, MAX_LATENCY / LATENCY_UNIT, self.start + width)
        return point.clip(lower, upper)

    def directions(self, names: Sequence[str], is_coupled: bool) -> Directions:
        """How some of the parameters, of which one is free at least, can move.

        The commands of a group of joints arrive together, so that they share the change of latency; every
        other parameter is a joint's own. What is a torque over motion moves with the stiffness: their common
        scale shows weakly, and differences of large derivatives would not tell it. Coupled directions are
        felt by the joints that the motion of a joint moves, too.
        """
        free, coupled = self._cfg.free, self._motion.coupled
        groups = self._motion.groups
        together = groups == np.array(list(dict.fromkeys(groups)))[:, None]
        steps, felt_by = [], []
        for name in free:
            along = np.isin(free, SCALE if name == "stiffness" else name) & np.isin(free, names)
            moved = together if name == "latency" else np.eye(len(groups), dtype=bool)
            for joints in moved if name in names else ():
                steps.append(np.outer(joints, along).astype(float))
                felt_by.append(coupled[joints].any(axis=0) if is_coupled else joints)
        return Directions(steps=np.array(steps), felt_by=np.array(felt_by))

    def report(self, residuals: Residuals) -> None:
        size = 1e3 * np.sqrt(np.mean(residuals**2))
        self._report(f"fitting at {1.0 / self._cfg.physics_dt:.0f} Hz, {size:.3f} mrad")

    def residuals(self, points: Sequence[Point]) -> Float[np.ndarray, "num_points num_settled num_joints"]:
        """Simulated minus measured positions [rad]."""
        return self._motion.simulate([self.dynamics(point) for point in points]) - self._measured

    def squares(self, point: Point, residuals: Residuals, weight: Weight) -> float:
        """Weighted squares of the residuals, and of the distance from the start over the prior."""
        distance = (point - self.start) / self._cfg.prior
        return float((residuals**2).sum(axis=0) @ weight + (distance**2).sum())

    def jacobian(self, point: Point, directions: Directions) -> Jacobian:
        """How the positions change about a point; what moves different joints moves at once."""
        batches = directions.together()
        shifts = [directions.steps[batch].sum(axis=0) for batch in batches]
        base, *shifted = self.residuals([point, *(point + DIFFERENCE * shift for shift in shifts)])
        source = np.zeros(len(directions.steps), dtype=int)
        for i, batch in enumerate(batches):
            source[batch] = i
        changes = (np.stack(shifted) - base) / DIFFERENCE
        return Jacobian(residuals=base, directions=directions, changes=changes, source=source)

    def normal_equations(self, point: Point, jacobian: Jacobian, weight: Weight) -> NormalEquations:
        """Those of `squares`, without the directions in which bounds forbid to follow the gradient."""
        directions, prior, distance = jacobian.directions, self._cfg.prior, point - self.start
        steps = directions.steps
        hessian = np.einsum("kja,lja->kl", steps, steps) / prior**2
        gradient = np.einsum("kja,ja->k", steps, distance) / prior**2
        for j, is_felt in enumerate(directions.felt_by.T):
            moving = np.flatnonzero(is_felt)
            columns = jacobian.changes[jacobian.source[moving], :, j]
            hessian[np.ix_(moving, moving)] += weight[j] * columns @ columns.T
            gradient[moving] += weight[j] * columns @ jacobian.residuals[:, j]
        ways = -np.sign(gradient)[:, None, None] * steps
        is_free = np.array([(self.bounded(point + LEAST_VALUE * way) != point).any() for way in ways])
        hessian = np.where(np.outer(is_free, is_free), hessian, np.diag(np.diagonal(hessian)))
        return NormalEquations(directions=directions, hessian=hessian, gradient=gradient * is_free)


def _solved(
    problem: _Problem, point: Point, directions: Directions, max_rounds: int
) -> tuple[Point, Jacobian]:
    """Move along some directions to where the squares are least; the point, residuals and Jacobian there.

    A Jacobian takes many simulations, so that it is followed as far as it leads.
    """
    jacobian = problem.jacobian(point, directions)
    for _ in range(max_rounds - 1):
        followed, _ = _followed(problem, point, jacobian)
        if (followed == point).all():
            return point, jacobian
        point, jacobian = followed, problem.jacobian(followed, directions)
    point, residuals = _followed(problem, point, jacobian)
    return point, replace(jacobian, residuals=residuals)


def _followed(
    problem: _Problem, point: Point, jacobian: Jacobian, least_share: float = 0.0
) -> tuple[Point, Residuals]:
    """Take steps under the same Jacobian while they are worth it and lessen the squares."""
    residuals = jacobian.residuals
    for _ in range(MAX_STEPS):
        weight = _information(residuals)
        squares = problem.squares(point, residuals, weight)
        equations = problem.normal_equations(point, replace(jacobian, residuals=residuals), weight)
        noise = correlation_time(residuals).mean() * len(equations.gradient)
        if equations.decrease < max(FINE**2 * noise, least_share * squares):
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
    """What a square of each joint's residuals weighs [1/rad²]: one over their mean square."""
    return 1.0 / np.maximum(np.mean(residuals**2, axis=0), LEAST_RESIDUAL**2)


def correlation_time(residuals: Residuals) -> Weight:
    """How many consecutive samples tell one independent thing: 1 for white noise, more for model errors.

    It is 1 plus twice the sum of the autocorrelations up to the first that is not positive.
    """
    centered = residuals - residuals.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(centered, n=2 * len(residuals), axis=0)) ** 2
    correlation = np.fft.irfft(spectrum, axis=0)[: len(residuals)]
    correlation = correlation / np.maximum(correlation[0], np.finfo(float).tiny)
    is_before = np.cumprod(correlation > 0.0, axis=0)
    return np.maximum(2.0 * (correlation * is_before).sum(axis=0) - 1.0, 1.0)
