"""Directions in which a fit moves, how positions change along them, and the squares about a point."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

MAX_STEP = 1.0  # longest step of a coordinate (ours; farther away motion is another)
Point = Float[np.ndarray, "num_joints num_columns"]
Residuals = Float[np.ndarray, "num_settled num_joints"]


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


@dataclass(frozen=True, kw_only=True)
class Jacobian:
    """Derivatives of the simulated positions at a point."""

    residuals: Residuals  #: simulated minus measured positions at the point [rad]
    directions: Directions  #: what moves
    #: change of the positions in each of some simulations, in which several directions moved
    changes: Float[np.ndarray, "num_simulations num_settled num_joints"]
    source: Int[np.ndarray, " num_directions"]  #: in which of these each direction moved
