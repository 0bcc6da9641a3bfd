"""The report of the stress suite, and the order of the methods in simulation beside the real robot's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import isnan
from statistics import fmean

from scipy.stats import kendalltau

from pixel2catch.envs.tasks import find_task
from pixel2catch.evaluation.metrics import Metrics, pooled_counts, wilson_interval
from pixel2catch.evaluation.policy_cells import PolicyResult
from pixel2catch.evaluation.report import Row, Section, percent, table
from pixel2catch.evaluation.stress.suite import REALITY
from pixel2catch.evaluation.stress.trained import is_trained_on

SHOWN = ("tracking_rate", "success_rate", "verified_hold_rate")  #: Rates in the rows.
UNTRAINED = "†"  #: Mark of a setting that a policy was not trained on.

REAL_ROBOT: dict[str, float] = {
    "proposed": 52.8,
    "object_position": 41.9,
    "single_agent": 31.8,
    "only_center": 14.4,
    "only_wh": 0.0,
}
"""S.R. [%] on the real robot by method, means over 360 throws. Source: the paper's journal version."""

Interval = tuple[float, float]


def stress_rows(results: Sequence[PolicyResult]) -> list[Row]:
    """Return a row for each result that there is."""
    rows = list[Row]()
    for each in results:
        if (content := each.read()) is not None:
            axis, level = each.setting.axis, each.setting.level
            kept = ("trials", *SHOWN, *(f"{name}_interval" for name in SHOWN))
            rows.append(
                {"setting": each.setting.name, "axis": axis.name, "level": level.label, "unit": axis.unit}
                | {"title": each.setting.title, "source": level.source}
                | {name: getattr(each.policy, name) for name in ("method", "task")}
                | {"policy": each.policy.name}
                | {"is_trained_on": is_trained_on(find_task(each.policy.task), level.change)}
                | {name: content["metrics"][name] for name in kept}
            )
    return rows


def stress_sections(rows: Sequence[Row]) -> list[Section]:
    """Return the parts of the report: S.R. by setting and policy, the order of the methods, the sources."""
    from pixel2catch.evaluation.figures import heat_map

    text = (
        f"S.R. [%], {rows[0]['trials']} throws each, 95 % interval. {UNTRAINED}: the policy was not trained "
        "on that disturbance."
    )
    lines = table(rows, ("title", "policy"), _percent)
    policies = dict.fromkeys(row["policy"] for row in rows)
    means = {name: fmean(r["success_rate"] for r in rows if r["policy"] == name) for name in policies}
    lines.append({"title": "mean over settings", **{n: f"{100 * mean:.1f}" for n, mean in means.items()}})
    sources = {row["title"]: row["source"] for row in rows}
    by, group = ("title", "policy"), "axis"
    if len(policies) > len(sources):  # the picture is higher than it is wide
        by, group = ("policy", "title"), "method"
    figure = heat_map(rows, by, group, _mark)
    return [
        Section(title="Success rates", text=text, rows=lines, figure=figure, file="heatmap.png"),
        Section(title="Order of the methods", text=_reality(rows)),
        Section(title="Sources", rows=[{"title": name, "source": each} for name, each in sources.items()]),
    ]


def _mark(row: Row) -> str:
    return "" if row["is_trained_on"] else UNTRAINED


def _percent(row: Row) -> str:
    return f"{percent(row['success_rate'], row['success_rate_interval'])} {_mark(row)}".rstrip()


def _reality(rows: Sequence[Row]) -> str:
    """Describe the order in the setting that is closest to reality, beside that of the real robot."""
    by_method: dict[str, list[Metrics]] = {}
    for row in rows:
        if row["level"] == REALITY:
            by_method.setdefault(row["method"], []).append(dict(row))
    if not by_method:
        return f"The setting '{REALITY}' was not computed: no order to compare."
    order = compare_methods(by_method)
    return order.sentence() if order else "Fewer than two methods that the real robot tried."


@dataclass(frozen=True, kw_only=True)
class Order:
    """Two orders of the same methods, best first."""

    simulated: tuple[str, ...]  #: The methods in the order of their success rates in simulation.
    real: tuple[str, ...]  #: The methods in the order of their success rates on the real robot.
    tau: float  #: Kendall's tau-b: 1 for the same order, -1 for the opposite one, 0 if all rates are equal.
    #: Mean over the methods of the largest difference on the real robot [points] from a method that is in
    #: the wrong order with it. Source: mean maximum rank violation of SIMPLER (Li et al. 2024).
    rank_violation: float
    num_settled: int  #: Pairs of methods whose 95 % intervals in simulation do not overlap.

    def sentence(self) -> str:
        """Describe the comparison."""
        pairs = len(self.real) * (len(self.real) - 1) // 2
        verdict = "agrees" if self.tau > 1.0 - 1e-9 else "does not agree"
        return (
            f"The order in simulation, {' > '.join(self.simulated)}, {verdict} with that of the real robot, "
            f"{' > '.join(self.real)}: Kendall's tau {self.tau:.2f} over {len(self.real)} methods, mean "
            f"maximum rank violation {self.rank_violation:.1f} points. "
            f"{self.num_settled} of {pairs} pairs differ by more than their 95 % intervals in simulation."
        )


def compare_methods(results: Mapping[str, Sequence[Metrics]]) -> Order | None:
    """Compare the methods, from the metrics of every policy of each; see `compare_orders`."""
    return compare_orders(
        {name: [each["success_rate"] for each in several] for name, several in results.items()},
        {name: wilson_interval(*pooled_counts(each, "success_rate")) for name, each in results.items()},
    )


def compare_orders(rates: Mapping[str, Sequence[float]], intervals: Mapping[str, Interval]) -> Order | None:
    """Compare the order of the methods with that of the real robot; return nothing for fewer than two.

    Args:
        rates: The S.R. of every policy of each method.
        intervals: The 95 % interval of each method's S.R.
    """
    methods = [method for method in REAL_ROBOT if method in rates]
    if len(methods) < 2:
        return None
    simulated = {method: fmean(rates[method]) for method in methods}
    bounds = [intervals[method] for method in methods]
    result = kendalltau(list(simulated.values()), [REAL_ROBOT[method] for method in methods])
    tau = float(result.statistic)  # pyright: ignore[reportAttributeAccessIssue] (made at run time)
    return Order(
        simulated=tuple(sorted(methods, key=lambda method: -simulated[method])),
        real=tuple(methods),
        tau=0.0 if isnan(tau) else tau,
        rank_violation=fmean(_largest_violation(each, simulated) for each in methods),
        num_settled=sum(a[1] < b[0] or b[1] < a[0] for a, b in combinations(bounds, 2)),
    )


def _largest_violation(method: str, simulated: Mapping[str, float]) -> float:
    """Return the largest difference on the real robot from a method in the opposite order [points]."""
    real = {other: REAL_ROBOT[method] - REAL_ROBOT[other] for other in simulated}
    return max(abs(real[o]) * ((real[o] < 0.0) != (simulated[method] < simulated[o])) for o in simulated)
