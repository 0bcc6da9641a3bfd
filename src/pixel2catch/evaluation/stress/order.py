"""The order of the methods in simulation beside the order on the real robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import isnan
from statistics import fmean

from scipy.stats import kendalltau

REAL_ROBOT: dict[str, float] = {
    "proposed": 52.8,
    "object_position": 41.9,
    "single_agent": 31.8,
    "only_center": 14.4,
    "only_wh": 0.0,
}
"""S.R. [%] on the real robot by method, means over 360 throws. Source: the paper's journal version."""

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Order:
    """Two orders of the same methods, best first.

    Attributes:
        simulated: By S.R. in simulation.
        real: By S.R. on the real robot.
        tau: Kendall's tau-b of the two: 1 is the same order, -1 the opposite one, 0 if all rates are equal.
        num_settled: Pairs of methods whose 95 % intervals in simulation do not overlap.
    """

    simulated: tuple[str, ...]
    real: tuple[str, ...]
    tau: float
    num_settled: int

    def sentence(self) -> str:
        """What it amounts to, in words."""
        pairs = len(self.real) * (len(self.real) - 1) // 2
        verdict = "agrees" if self.tau > 1.0 - 1e-9 else "does not agree"
        return (
            f"The order in simulation, {' > '.join(self.simulated)}, {verdict} with that of the real robot, "
            f"{' > '.join(self.real)}: Kendall's tau {self.tau:.2f} over {len(self.real)} methods. "
            f"{self.num_settled} of {pairs} pairs differ by more than their 95 % intervals in simulation."
        )


def compare_orders(rates: Mapping[str, Sequence[float]], intervals: Mapping[str, Interval]) -> Order | None:
    """Compare the methods that both have.

    Args:
        rates: S.R. of every policy of a method, by method.
        intervals: The 95 % interval of each method's S.R.

    Returns:
        The two orders; nothing if there are fewer than two methods to compare.
    """
    methods = [method for method in REAL_ROBOT if method in rates]
    if len(methods) < 2:
        return None
    simulated = {method: fmean(rates[method]) for method in methods}
    return Order(
        simulated=tuple(sorted(methods, key=lambda method: -simulated[method])),
        real=tuple(methods),
        tau=_kendall_tau([simulated[m] for m in methods], [REAL_ROBOT[m] for m in methods]),
        num_settled=sum(_is_apart(intervals[a], intervals[b]) for a, b in combinations(methods, 2)),
    )


def _kendall_tau(first: Sequence[float], second: Sequence[float]) -> float:
    """Kendall's tau-b of two rankings of the same things; 0 where one of them tells nothing apart."""
    result = kendalltau(first, second)
    tau = float(result.statistic)  # pyright: ignore[reportAttributeAccessIssue] (made at run time)
    return 0.0 if isnan(tau) else tau


def _is_apart(first: Interval, second: Interval) -> bool:
    return first[1] < second[0] or second[1] < first[0]
