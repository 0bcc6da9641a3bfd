"""The report of the stress suite: tables, a picture, and the methods in their order beside the real one."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from math import isnan
from pathlib import Path
from statistics import fmean

from scipy.stats import kendalltau

from pixel2catch.envs.tasks import find_task
from pixel2catch.evaluation.heat_map import heat_map
from pixel2catch.evaluation.metrics import Metrics, pooled_counts, wilson_interval
from pixel2catch.evaluation.report import Cells, csv_text, latex, markdown, percent, write_files
from pixel2catch.evaluation.stress.measuring import Json, Result
from pixel2catch.evaluation.stress.suite import REALITY
from pixel2catch.evaluation.stress.trained import is_trained_on
from pixel2catch.files import json_text

SHOWN = ("tracking_rate", "success_rate", "verified_hold_rate")  #: Rates that the tables keep.

REAL_ROBOT: dict[str, float] = {
    "proposed": 52.8,
    "object_position": 41.9,
    "single_agent": 31.8,
    "only_center": 14.4,
    "only_wh": 0.0,
}
"""S.R. [%] on the real robot by method, means over 360 throws. Source: the paper's journal version."""

Interval = tuple[float, float]

UNTRAINED = "*"  #: Mark of a setting that a policy was not trained on.


def make_table(results: Sequence[Result], contents: Sequence[Json]) -> Json:
    """The whole report as plain data, of results setting by setting and what `measure` returned for them."""
    entries = [each.policy for each in results]
    policies = {each.name: {"method": each.method, "task": each.task} for each in entries}
    settings: dict[str, Json] = {}
    for each, content in zip(results, contents, strict=True):
        level, axis = each.setting.level, each.setting.axis
        row = {"axis": axis.name, "unit": axis.unit, "label": level.label, "source": level.source}
        row |= {"title": each.setting.title, "rates": {}}
        is_trained = is_trained_on(find_task(each.policy.task), level.change)
        kept = ("trials", *SHOWN, *(f"{name}_interval" for name in SHOWN))
        rates = {name: content["metrics"][name] for name in kept} | {"is_trained_on": is_trained}
        settings.setdefault(each.setting.name, row)["rates"][each.policy.name] = rates
    means = {
        name: fmean(row["rates"][name]["success_rate"] for row in settings.values()) for name in policies
    }
    return {
        "policies": policies,
        "settings": settings,
        "mean": means,
        "reality": _reality(policies, settings),
    }


def write_report(out: Path, table: Json) -> None:
    """Write the files of the report, all or none."""
    sources = "".join(f"- {row['title']}: {row['source']}\n" for row in table["settings"].values())
    files = {
        "table.json": json_text(table),
        "table.csv": as_csv(table),
        "table.md": f"{as_markdown(table)}\n## Where the numbers come from\n\n{sources}",
        "table.tex": latex(_rows(table), num_text_columns=1),
        "heatmap.png": heatmap(table),
    }
    write_files(out, files)


def as_csv(table: Json) -> str:
    """One row for every policy under every setting."""
    place = ("setting", "axis", "level", "unit", "policy", "method", "is_trained_on", "trials")
    rates_columns = [column for name in SHOWN for column in (name, f"{name}_low", f"{name}_high")]
    rows = []
    for name, row in table["settings"].items():
        for policy, rates in row["rates"].items():
            method, is_trained = table["policies"][policy]["method"], rates["is_trained_on"]
            values = [value for rate in SHOWN for value in (rates[rate], *rates[f"{rate}_interval"])]
            where = (name, row["axis"], row["label"], row["unit"], policy, method)
            where += (str(is_trained).lower(), rates["trials"])
            rows.append((*where, *(f"{value:.5f}" for value in values)))
    return csv_text((*place, *rates_columns), rows)


def as_markdown(table: Json) -> str:
    """S.R. in percent with its 95 % interval, settings by policies; then the orders of the methods.

    What a policy was not trained on is marked.
    """
    trials = next(iter(next(iter(table["settings"].values()))["rates"].values()))["trials"]
    marked = rf"\{UNTRAINED}: the policy was not trained on that disturbance."
    rows = markdown(_rows(table), num_text_columns=len(table["policies"]) + 1)
    head = f"S.R. [%], {trials} throws each, 95 % interval. {marked}"
    return "\n".join(["# Stress suite", "", head, "", rows, table["reality"]["sentence"], ""])


def _rows(table: Json) -> list[Cells]:
    rows = [
        {"setting": row["title"], **{name: _percent(row["rates"][name]) for name in table["policies"]}}
        for row in table["settings"].values()
    ]
    means = {name: f"{100 * mean:.1f}" for name, mean in table["mean"].items()}
    return [*rows, {"setting": "**mean over settings**", **means}]


def _percent(rates: Json) -> str:
    mark = "" if rates["is_trained_on"] else rf" \{UNTRAINED}"
    return percent(rates["success_rate"], rates["success_rate_interval"]) + mark


def _reality(policies: Json, settings: Json) -> Json:
    """The order of the methods in the setting that is closest to reality, beside the real robot's."""
    rows = [row for row in settings.values() if row["label"] == REALITY]
    if not rows:
        return {"sentence": f"The setting '{REALITY}' was not asked for: no order to compare."}
    by_method: dict[str, list[Json]] = {}
    for name, rates in rows[0]["rates"].items():
        by_method.setdefault(policies[name]["method"], []).append(rates)
    order = compare_methods(by_method)
    if order is None:
        return {"sentence": "Fewer than two methods that the real robot tried: no order to compare."}
    real = {method: REAL_ROBOT[method] for method in order.real}
    return {**asdict(order), "real_success_percent": real, "sentence": order.sentence()}


@dataclass(frozen=True, kw_only=True)
class Order:
    """Two orders of the same methods, best first."""

    simulated: tuple[str, ...]  #: By S.R. in simulation.
    real: tuple[str, ...]  #: By S.R. on the real robot.
    #: Kendall's tau-b of the two: 1 is the same order, -1 the opposite one, 0 if all rates are equal.
    tau: float
    #: Of each method the largest difference on the real robot [points] from one that it is in the wrong order
    #: with; their mean. Source: mean maximum rank violation of SIMPLER (Li et al. 2024).
    rank_violation: float
    num_settled: int  #: Pairs of methods whose 95 % intervals in simulation do not overlap.

    def sentence(self) -> str:
        """What it amounts to, in words."""
        pairs = len(self.real) * (len(self.real) - 1) // 2
        verdict = "agrees" if self.tau > 1.0 - 1e-9 else "does not agree"
        return (
            f"The order in simulation, {' > '.join(self.simulated)}, {verdict} with that of the real robot, "
            f"{' > '.join(self.real)}: Kendall's tau {self.tau:.2f} over {len(self.real)} methods, mean "
            f"maximum rank violation {self.rank_violation:.1f} points. "
            f"{self.num_settled} of {pairs} pairs differ by more than their 95 % intervals in simulation."
        )


def compare_methods(results: Mapping[str, Sequence[Metrics]]) -> Order | None:
    """Compare the methods, by the metrics of every policy of each; see `compare_orders`."""
    return compare_orders(
        {name: [each["success_rate"] for each in several] for name, several in results.items()},
        {name: wilson_interval(*pooled_counts(each, "success_rate")) for name, each in results.items()},
    )


def compare_orders(rates: Mapping[str, Sequence[float]], intervals: Mapping[str, Interval]) -> Order | None:
    """Compare the methods that both have; nothing if there are fewer than two.

    Rates are the S.R. of every policy of a method, intervals the 95 % interval of each method's S.R.
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
    """Largest difference on the real robot from a method of which simulation says the opposite [points]."""
    real = {other: REAL_ROBOT[method] - REAL_ROBOT[other] for other in simulated}
    return max(abs(real[o]) * ((real[o] < 0.0) != (simulated[method] < simulated[o])) for o in simulated)


def heatmap(table: Json) -> bytes:
    """The table of `make_table` as one picture: settings by policies, S.R. in the cells; a PNG file."""
    settings, names = list(table["settings"].values()), list(table["policies"])
    rates = [[100.0 * row["rates"][name]["success_rate"] for name in names] for row in settings]
    rates.append([100.0 * table["mean"][name] for name in names])
    marks = [["" if row["rates"][name]["is_trained_on"] else UNTRAINED for name in names] for row in settings]
    marks.append([""] * len(names))
    titles, axes_names = [row["title"] for row in settings], [row["axis"] for row in settings]
    return heat_map(
        rates,
        marks,
        [*titles, "mean over settings"],
        [name.replace("_", "\n") for name in names],
        [*axes_names, "mean"],
        f"S.R. [% of throws]; {UNTRAINED} not trained on",
    )
