"""Standardisation by the statistics of all processes together."""

from typing import Any

import torch
from skrl.resources.preprocessors.torch import RunningStandardScaler
from torch import Tensor

from pixel2catch.rl.workers import Workers

EPSILON = 1e-8
"""Added to a standard deviation before dividing by it. Source: skrl (`compute_gae`)."""


class JointScaler(RunningStandardScaler):
    """skrl's scaler, whose statistics are those of all processes, the same in each."""

    def __init__(self, *, workers: Workers, **arguments: Any) -> None:
        """Build skrl's scaler."""
        super().__init__(**arguments)
        self._workers = workers

    def _parallel_variance(self, input_mean: Tensor, input_var: Tensor, input_count: int) -> None:
        mean, variance = joint_moments(self._workers, input_mean, input_var, input_count)
        super()._parallel_variance(mean, variance, input_count * self._workers.size)


def joint_moments(workers: Workers, mean: Tensor, variance: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return mean and unbiased variance of the samples of all processes.

    Source: law of total variance: the mean of the variances, and the variance of the means.

    Args:
        workers: All processes.
        mean: Mean of this process's samples.
        variance: Their unbiased variance.
        count: Their number, the same in every process.
    """
    if workers.size == 1:
        return mean, variance
    joint_mean = mean.to(torch.float64, copy=True)
    workers.average([joint_mean])
    spread = variance.double() * ((count - 1) / count) + (mean - joint_mean).square()
    workers.average([spread])
    total = count * workers.size
    return joint_mean, spread * (total / (total - 1))


def standardised(workers: Workers, values: Tensor) -> Tensor:
    """Return values with mean 0 and standard deviation 1 over all processes."""
    mean, variance = joint_moments(workers, values.mean(), values.var(), values.numel())
    return (values - mean.to(values)) / (variance.to(values).sqrt() + EPSILON)
