"""The least squares problem of the fit: its coordinates, residuals and derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification.fit_simulation import FIT_DT, RecordedMotion
from pixel2catch.identification.recording import Recording
from pixel2catch.robot.joint_dynamics import PARAMETERS, JointDynamics

SERVO_PARAMETERS = ("stiffness", "damping", "frictionloss", "armature", "latency")
"""What is fitted where commands reach the servo unfiltered."""

FILTER_PARAMETERS = ("filter_gain", "filter_lookahead", "latency")
"""What is fitted of the command path in front of a servo that is known."""

LATENCY_UNIT = 0.01
"""Latency that counts as much as a factor e of another parameter [s]. Source: ours."""

MAX_LATENCY = 0.2
"""Largest latency that a fit tries [s]. Source: ours."""

MAX_FACTOR = 1e3
"""Largest factor between the start and the result of any other parameter. Source: ours."""

LEAST_VALUE = 1e-9
"""What a fit takes for 0 where it needs a logarithm."""

DIFFERENCE = 1e-3
"""Step of the finite differences, in the coordinates of the fit. Source: ours."""


TOLERANCE = 1e-4
"""Relative change of the squared errors, and of the coordinates, at which a fit ends. Source: ours."""

Point = Float[np.ndarray, "num_joints num_free"]


@dataclass(frozen=True, kw_only=True)
class FitCfg:
    """How the dynamics are fitted.

    Attributes:
        free: Parameters that are fitted; the others keep their start values.
        noise: Standard deviation of the encoders [rad]; what it weighs is the prior, so its size suffices.
        prior: Standard deviation of what is known before, in the coordinates of the fit: 2 is a factor 7.
        physics_dt: Time step of the simulation [s].
        max_iterations: Most iterations.
    """

    free: tuple[str, ...] = SERVO_PARAMETERS
    noise: float = 2e-4
    prior: float = 2.0
    physics_dt: float = FIT_DT
    max_iterations: int = 30

    def __post_init__(self) -> None:
        """Refuse unknown parameters, none at all, and sizes that are not positive."""
        for name in self.free:
            if name not in PARAMETERS:
                raise UnknownNameError("parameter", name, PARAMETERS)
        if not self.free:
            raise InvalidValueError(f"nothing is free to be fitted; name some of {', '.join(PARAMETERS)}")
        for name in ("noise", "prior", "physics_dt", "max_iterations"):
            if not getattr(self, name) > 0:
                raise InvalidValueError(f"{name} is {getattr(self, name):g}; it must be more than 0")


class Coordinates:
    """The free parameters as the numbers that the optimiser moves, one row per joint."""

    def __init__(self, start: JointDynamics, free: tuple[str, ...]) -> None:
        """Remember the start, which also has the values of what is not free.

        Raises:
            InvalidValueError: The filter is free, but the start has none.
        """
        if {"filter_gain", "filter_lookahead"} & set(free) and not start.has_filter.all():
            raise InvalidValueError(
                "the command filter is to be fitted, but the start has none; "
                "start with filter_gain=300 and filter_lookahead=0.1, the settings of servoJ."
            )
        self._start = start
        self._free = free
        self._is_latency = np.array([name == "latency" for name in free])

    def of(self, dynamics: JointDynamics) -> Point:
        """Where the dynamics are."""
        values = np.stack([getattr(dynamics, name) for name in self._free], axis=-1)
        logarithms = np.log(np.maximum(values, LEAST_VALUE))
        return np.where(self._is_latency, values / LATENCY_UNIT, logarithms)

    def dynamics(self, point: Point) -> JointDynamics:
        """The dynamics at a point."""
        with np.errstate(over="ignore"):  # a latency is no exponent
            values = np.where(self._is_latency, point * LATENCY_UNIT, np.exp(point))
        columns = {name: values[:, i].copy() for i, name in enumerate(self._free)}
        return self._start.with_values(**columns)

    def bounds(self) -> tuple[Point, Point]:
        """Lowest and highest points."""
        center, width = self.of(self._start), np.log(MAX_FACTOR)
        lower = np.where(self._is_latency, 0.0, center - width)
        upper = np.where(self._is_latency, MAX_LATENCY / LATENCY_UNIT, center + width)
        return lower, upper


class Problem:
    """How far simulation is from some recordings, at points in the coordinates of a fit."""

    def __init__(self, recordings: Sequence[Recording], start: JointDynamics, cfg: FitCfg) -> None:
        """Prepare the simulation.

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

    def solve(self, start: Point, names: Sequence[str]) -> Point:
        """Move those of the free parameters that are named until the squares are least."""
        active = [i for i, name in enumerate(self._cfg.free) if name in names]
        if not active:
            return start

        def point(flat: np.ndarray) -> Point:
            moved = start.copy()
            moved[:, active] = flat.reshape(-1, len(active))
            return moved

        lower, upper = (bound[:, active].ravel() for bound in self.coordinates.bounds())
        result = least_squares(
            lambda flat: self._residuals(point(flat), active),
            start[:, active].ravel().clip(lower, upper),
            jac=lambda flat: self._jacobian(point(flat), active),  # pyright: ignore[reportArgumentType]
            bounds=(lower, upper),
            max_nfev=self._cfg.max_iterations,
            xtol=TOLERANCE,
            ftol=TOLERANCE,
        )
        return point(result.x)

    def errors(self, point: Point) -> Float[np.ndarray, "num_settled num_joints"]:
        """Simulated minus measured positions [rad]."""
        (simulated,) = self._motion.simulate([self.coordinates.dynamics(point)])
        return simulated - self._measured

    def derivatives(
        self, point: Point, shifts: Float[np.ndarray, "num_shifts num_joints num_free"]
    ) -> Float[np.ndarray, "num_shifts num_settled num_joints"]:
        """Derivatives of the simulated positions along each shift [rad]."""
        points = [point, *(point + DIFFERENCE * shift for shift in shifts)]
        base, *shifted = self._motion.simulate([self.coordinates.dynamics(each) for each in points])
        return (np.stack(shifted) - base) / DIFFERENCE

    def _residuals(self, point: Point, active: Sequence[int]) -> np.ndarray:
        """Errors over the noise, joint after joint, then distances from the start over the prior."""
        distance = (point - self.start)[:, active] / self._cfg.prior
        return np.concatenate((self.errors(point).T.ravel() / self._cfg.noise, distance.ravel()))

    def _jacobian(self, point: Point, active: Sequence[int]) -> np.ndarray:
        """Derivatives of each joint's residuals by its own parameters; those by the others' are left out.

        All joints move their parameter at once, so that one column for each kind of parameter is simulated: a
        joint hardly feels what changes in another's servo. What is left out costs iterations, not accuracy.
        """
        num_joints, num_free = point.shape
        shifts = np.repeat(np.eye(num_free)[active][:, None, :], num_joints, axis=1)
        columns = self.derivatives(point, shifts)
        blocks = [columns[:, :, j].T for j in range(num_joints)]
        data = np.asarray(block_diag(*blocks)) / self._cfg.noise
        return np.concatenate((data, np.eye(num_joints * len(active)) / self._cfg.prior))
