"""The report of the stress suite, and the order of the methods in simulation beside the real robot's."""

from collections.abc import Sequence
from itertools import combinations
from math import comb, isnan
from statistics import fmean

from scipy.stats import kendalltau

from pixel2catch.envs.tasks import find_task
from pixel2catch.evaluation.metrics import pooled_counts, wilson_interval
from pixel2catch.evaluation.policy_cells import PolicyResult
from pixel2catch.evaluation.report import Row, percent, table
from pixel2catch.evaluation.stress.suite import REALITY
from pixel2catch.evaluation.stress.trained import is_trained_on
from pixel2catch.reports import Cells, Section

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

ORDER_NOTE = (
    f"The paper's real robot has {' > '.join(REAL_ROBOT)}, an S.R. of "
    f"{', '.join(f'{rate:g}' for rate in REAL_ROBOT.values())} % over 360 throws each. Kendall's tau is 1 "
    "for the same order and -1 for the opposite one. Rank violation: mean over the methods of the largest "
    "difference on the real robot [points] from a method that is in the wrong order with it. A pair is "
    "settled if its 95 % intervals in simulation do not overlap."
)


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
                | {"method": each.policy.method, "task": each.policy.task, "policy": each.policy.name}
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
    picture = heat_map(rows, by, group, _mark)
    order = compare_order([row for row in rows if row["level"] == REALITY])
    sections = [
        Section(title="Success rates", text=text, rows=lines, pictures={"heatmap.png": picture}),
        Section(title="Sources", rows=[{"title": name, "source": each} for name, each in sources.items()]),
    ]
    if order:
        note = f"In the setting '{REALITY}'. {ORDER_NOTE}"
        sections.insert(1, Section(title="Order of the methods", text=note, rows=[order_line(order)]))
    return sections


def _mark(row: Row) -> str:
    return "" if row["is_trained_on"] else UNTRAINED


def _percent(row: Row) -> str:
    return f"{percent(row['success_rate'], row['success_rate_interval'])} {_mark(row)}".rstrip()


def compare_order(rows: Sequence[Row]) -> Row | None:
    """Compare the order of the methods by mean S.R. with that of the real robot.

    Returns:
        Nothing for fewer than two methods. Else the methods in the order of their success rates, best first,
        as `simulated` and `real`; Kendall's tau-b, 0 if all rates are equal, as `tau`; the mean maximum rank
        violation of SIMPLER (Li et al. 2024) [points] as `rank_violation`; the number of settled pairs as
        `num_settled`.
    """
    found = {method: [row for row in rows if row["method"] == method] for method in REAL_ROBOT}
    found = {method: several for method, several in found.items() if several}
    if len(found) < 2:
        return None
    real = {method: REAL_ROBOT[method] for method in found}
    rates = {method: fmean(row["success_rate"] for row in several) for method, several in found.items()}
    bounds = [wilson_interval(*pooled_counts(several, "success_rate")) for several in found.values()]
    result = kendalltau(list(rates.values()), list(real.values()))
    tau = float(result.statistic)  # pyright: ignore[reportAttributeAccessIssue] (made at run time)
    violations = [
        max(abs(real[a] - real[b]) * ((real[a] < real[b]) != (rates[a] < rates[b])) for b in found)
        for a in found
    ]
    return {
        "simulated": tuple(sorted(found, key=lambda method: -rates[method])),
        "real": tuple(found),
        "tau": 0.0 if isnan(tau) else tau,
        "rank_violation": fmean(violations),
        "num_settled": sum(a[1] < b[0] or b[1] < a[0] for a, b in combinations(bounds, 2)),
    }


def order_line(order: Row) -> Cells:
    """Return the line of a table for the result of `compare_order`."""
    return {
        "order of S.R.": " > ".join(order["simulated"]),
        "Kendall's tau": f"{order['tau']:.2f}",
        "rank violation": f"{order['rank_violation']:.1f}",
        "settled pairs": f"{order['num_settled']} of {comb(len(order['real']), 2)}",
    }
