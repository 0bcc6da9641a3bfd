"""Rows and reports of stress and transfer studies; the order of the methods beside that on the real robot."""

from collections.abc import Callable, Sequence
from itertools import combinations
from math import comb, isnan
from statistics import fmean

from scipy.stats import kendalltau

from pixel2catch.envs.tasks import find_task
from pixel2catch.evaluation.figures import heat_map
from pixel2catch.evaluation.metrics import paired_difference, pooled_counts, wilson_interval
from pixel2catch.evaluation.policy_cells import EVENTS, PolicyResult
from pixel2catch.evaluation.report import Row, percent, table
from pixel2catch.evaluation.result_tables import RATES
from pixel2catch.evaluation.stress.suite import REALITY, Setting
from pixel2catch.evaluation.stress.trained import is_trained_on
from pixel2catch.reports import Cells, Section

KEPT = ("trials", *EVENTS, *(f"{name}_interval" for name in EVENTS), "failures", "max_penetration")
"""Metrics in the rows."""

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


def result_rows(results: Sequence[PolicyResult], home_of: Callable[[Setting], str]) -> list[Row]:
    """Return a row for each result that there is.

    `home_of` returns the name of the setting that another one is compared with: `success_rate_change` and its
    like have the difference from it over the same throws.
    """
    found = {
        (each.policy.name, each.setting.name): content["metrics"]
        for each in results
        if (content := each.read()) is not None
    }
    rows = list[Row]()
    for each in results:
        policy, setting, level = each.policy, each.setting, each.setting.level
        metrics, home = found.get((policy.name, setting.name)), home_of(setting)
        if metrics is None:
            continue
        row = {
            "setting": setting.name,
            "axis": setting.axis.name,
            "level": level.label,
            "unit": setting.axis.unit,
            "title": setting.title,
            "source": level.source,
            "method": policy.method,
            "task": policy.task,
            "policy": policy.name,
            "is_trained_on": is_trained_on(find_task(policy.task), level.change),
            **{name: metrics[name] for name in KEPT if name in metrics},
        }
        throws, at_home = (one.get("throws") for one in (metrics, found.get((policy.name, home), {})))
        if home != setting.name and throws and at_home:
            for name, event in EVENTS.items():
                row[f"{name}_change"] = paired_difference(at_home[event], throws[event])
        rows.append(row)
    return rows


def stress_sections(rows: Sequence[Row]) -> list[Section]:
    """Return the parts of the report: S.R. by setting and policy, the order of the methods, the sources."""
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
    pictures = {"heatmap.png": heat_map(rows, by, group, _mark)}
    return [
        Section(title="Success rates", text=text, rows=lines, pictures=pictures),
        *order_sections([row for row in rows if row["level"] == REALITY]),
        Section(title="Sources", rows=[{"title": name, "source": each} for name, each in sources.items()]),
    ]


def transfer_sections(rows: Sequence[Row]) -> list[Section]:
    """Return the parts of the report: rates and differences from home, and the order of the methods."""
    text = (
        f"{rows[0]['trials']} throws each, the same in all engines; home is {rows[0]['axis']}. Rates in % "
        "with their 95 % interval; difference of S.R. from home in points with its 95 % interval, number of "
        "throws lost and won by it, and p value of McNemar's exact test. Failures in % of the throws."
    )
    policies = [*dict.fromkeys(row["policy"] for row in rows)]
    ordered = sorted(rows, key=lambda row: policies.index(row["policy"]))
    places = [{**row, "place": f"{row['policy']}, restitution {row['level']}"} for row in ordered]
    pictures = {"heatmap.png": heat_map(places, ("place", "axis"), "policy", _difference, digits=1)}
    lines = [_transfer_line(row) for row in ordered]
    return [Section(title="Engines", text=text, rows=lines, pictures=pictures), *order_sections(rows)]


def order_sections(rows: Sequence[Row]) -> list[Section]:
    """Return the order of the methods in every setting; no section without a setting of two methods."""
    lines = list[Cells]()
    for title in dict.fromkeys(row["title"] for row in rows):
        if order := compare_order([row for row in rows if row["title"] == title]):
            lines.append(
                {
                    "setting": title,
                    "order of S.R.": " > ".join(order["simulated"]),
                    "Kendall's tau": f"{order['tau']:.2f}",
                    "rank violation": f"{order['rank_violation']:.1f}",
                    "settled pairs": f"{order['num_settled']} of {comb(len(order['real']), 2)}",
                }
            )
    return [Section(title="Order of the methods", text=ORDER_NOTE, rows=lines)] if lines else []


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


def _mark(row: Row) -> str:
    return "" if row["is_trained_on"] else UNTRAINED


def _percent(row: Row) -> str:
    return f"{percent(row['success_rate'], row['success_rate_interval'])} {_mark(row)}".rstrip()


def _transfer_line(row: Row) -> Cells:
    line = {"policy": row["policy"], "restitution": row["level"], "engine": row["axis"]}
    line |= {
        title: percent(row[name], row[f"{name}_interval"]) for title, name in RATES.items() if name in row
    }
    difference, counts, p = "home", "", ""
    if change := row.get("success_rate_change"):
        low, high = (100.0 * bound for bound in change["difference_interval"])
        difference = f"{_difference(row)} [{low:+.1f}, {high:+.1f}]"
        counts, p = f"{change['lost']}, {change['won']}", f"{change['p_value']:.2g}"
    line |= {"difference": difference, "lost, won": counts, "p": p}
    return line | {name.replace("_", " "): f"{100.0 * rate:.1f}" for name, rate in row["failures"].items()}


def _difference(row: Row) -> str:
    change = row.get("success_rate_change")
    return f"{100.0 * change['difference']:+.1f}" if change else ""
