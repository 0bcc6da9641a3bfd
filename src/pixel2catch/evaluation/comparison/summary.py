"""What several seeds of a method amount to: means and deviations over them, intervals, learning curves."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.comparison.plan import GROUPS, ComparisonFolder, Plan, Run
from pixel2catch.evaluation.metrics import Metrics, pooled_counts, wilson_interval
from pixel2catch.evaluation.report import MAIN_RATES, PAPER, RATES, csv_text
from pixel2catch.files import read_text, reading
from pixel2catch.scene.objects import OBJECT_GROUPS

MAXIMA = ("max_joint_speed", "max_torque_share", "max_penetration")
"""Extremes that the tables show: the largest of all seeds."""

Row = dict[str, Any]

CURVES = ("transitions", "episodes", *MAIN_RATES.values())  #: Columns that curves are made of.

NUM_BINS = 60  #: Most bins from the start to the end of the longest training. Source: ours.

Columns = Mapping[str, Float[ndarray, " num_updates"]]


def mean_and_deviation(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean and sample deviation (divisor n - 1); one value has no deviation."""
    return fmean(values), stdev(values) if len(values) > 1 else None


def pooled(rates: Sequence[Metrics], name: str) -> Row:
    """One rate over seeds: `mean` and `deviation`, 95 % `interval` over all trials, and the `values`."""
    values = [result[name] for result in rates]
    mean, deviation = mean_and_deviation(values)
    interval = wilson_interval(*pooled_counts(rates, name))
    return {"mean": mean, "deviation": deviation, "interval": list(interval), "values": values}


def summary_rows(folder: ComparisonFolder, plan: Plan) -> Iterator[Row]:
    """One row for every method and set of objects of which there are results."""
    for method in plan.methods:
        for group in GROUPS:
            results = _results(folder, plan, method, group)
            if results:
                yield {
                    "method": method,
                    "objects": group,
                    "seeds": len(results),
                    "trials": sum(result["trials"] for result in results),
                    **{name: pooled(results, name) for name in RATES.values()},
                    **{name: max(result[name] for result in results) for name in MAXIMA},
                    "paper": _paper(method, group),
                }


def object_rows(folder: ComparisonFolder, plan: Plan) -> Iterator[Row]:
    """One row for every object, seen ones first, and method of which there are results."""
    results = {
        (group, method): _results(folder, plan, method, group) for group in GROUPS for method in plan.methods
    }
    for group in GROUPS:
        for name in OBJECT_GROUPS[group]:
            for method in plan.methods:
                thrown = [r["objects"][name] for r in results[group, method] if name in r["objects"]]
                if thrown:
                    trials = sum(rates["trials"] for rates in thrown)
                    yield {"object": name, "objects": group, "method": method, "trials": trials} | {
                        metric: _overall(thrown, metric) for metric in MAIN_RATES.values()
                    }


def training_rows(folder: ComparisonFolder, plan: Plan) -> Iterator[Row]:
    """One row for every finished training."""
    for run in plan.runs():
        summary = folder.summary(run)
        if summary is not None and folder.is_trained(run):
            row = {name: summary[name] for name in ("transitions", "seconds")}
            yield {"method": run.method, "seed": run.seed} | row


def _results(folder: ComparisonFolder, plan: Plan, method: str, group: str) -> list[Metrics]:
    found = (folder.result(Run(method=method, seed=seed), group) for seed in range(plan.seeds))
    return [result for result in found if result is not None]


def _overall(rates: Sequence[Metrics], name: str) -> Row:
    """Rate over all trials with its interval: seeds have thrown an object unequally often."""
    successes, trials = pooled_counts(rates, name)
    return {"pooled": successes / trials, "interval": list(wilson_interval(successes, trials))}


def _paper(method: str, group: str) -> Row | None:
    numbers = PAPER.get((method, OBJECT_GROUPS[group]))
    if numbers is None:
        return None
    return {
        name: {"mean": round(mean / 100, 6), "deviation": round(deviation / 100, 6)}
        for name, (mean, deviation) in zip(MAIN_RATES.values(), numbers, strict=True)
    }


@dataclass(frozen=True, kw_only=True)
class Curves:
    """Rates in training, with the stochastic policy, in bins of transitions."""

    edges: Float[ndarray, " num_edges"]  #: Edges of the bins [transitions].
    seeds: dict[str, tuple[int, ...]]  #: By method, the seeds that there are.
    #: By method and name of the rate, one row a seed; NaN where a seed has no value.
    rates: dict[str, dict[str, Float[ndarray, "num_seeds num_bins"]]]

    @property
    def transitions(self) -> Float[ndarray, " num_bins"]:
        """Middles of the bins."""
        return (self.edges[1:] + self.edges[:-1]) / 2

    def mean_and_deviation(
        self, method: str, name: str
    ) -> tuple[Float[ndarray, " num_bins"], Float[ndarray, " num_bins"]]:
        """Mean and sample deviation over seeds, where all seeds have a value; deviation 0 of one seed."""
        values = self.rates[method][name]
        several = len(values) > 1
        return values.mean(axis=0), values.std(axis=0, ddof=1) if several else np.zeros(values.shape[1])


MOST_METRICS = 2**26
"""Bytes of a `metrics.csv`; those of the longest trainings here have some hundred thousand. Source: ours."""


def read_metrics(path: Path, names: Sequence[str] = CURVES) -> Columns:
    """Columns of a `metrics.csv`, which may be being written: those that curves are made of, or others.

    Raises:
        InvalidValueError: It cannot be read, or is none.
    """
    with reading("metrics", path, "Train anew, or take the file out of the comparison."):
        try:
            table = csv.DictReader(io.StringIO(read_text(path, MOST_METRICS)))
            rows = [[float(row[name] or "nan") for name in names] for row in table]
        except csv.Error as error:
            raise InvalidValueError(f"it is no table ({error})") from error
    return dict(zip(names, np.array(rows).reshape(-1, len(names)).T, strict=True))


def binned(columns: Columns, name: str, edges: Float[ndarray, " num_edges"]) -> Float[ndarray, " num_bins"]:
    """Rate over all episodes that ended in a bin.

    Bins between others in which none ended are interpolated; before the first and after the last is nothing.
    """
    has_rate = columns["episodes"] > 0
    episodes, rate = columns["episodes"][has_rate], columns[name][has_rate]
    transitions = columns["transitions"][has_rate]
    total, _ = np.histogram(transitions, edges, weights=episodes)
    events, _ = np.histogram(transitions, edges, weights=episodes * rate)
    filled = np.flatnonzero(total)
    if len(filled) == 0:
        return np.full(len(total), np.nan)
    everywhere = np.arange(len(total))
    return np.interp(everywhere, filled, events[filled] / total[filled], left=np.nan, right=np.nan)


def all_curves(folder: ComparisonFolder, plan: Plan) -> Curves | None:
    """Curves of all trainings that have begun to log, or nothing if none has."""
    logs: dict[str, dict[int, Columns]] = {}
    for method in plan.methods:
        paths = {seed: folder.metrics(Run(method=method, seed=seed)) for seed in range(plan.seeds)}
        columns = {seed: read_metrics(path) for seed, path in paths.items() if path.exists()}
        columns = {seed: each for seed, each in columns.items() if len(each["transitions"])}
        if columns:
            logs[method] = columns
    return gather(logs) if logs else None


def gather(logs: Mapping[str, Mapping[int, Columns]]) -> Curves:
    """Put the metrics of every method's seeds on a common grid."""
    everything = (columns["transitions"] for several in logs.values() for columns in several.values())
    longest = max(everything, key=lambda transitions: transitions[-1])
    edges = np.linspace(0.0, longest[-1], min(NUM_BINS, len(longest)) + 1)
    rates = {
        method: {
            name: np.stack([binned(columns, name, edges) for columns in several.values()])
            for name in MAIN_RATES.values()
        }
        for method, several in logs.items()
    }
    seeds = {method: tuple(several) for method, several in logs.items()}
    return Curves(edges=edges, seeds=seeds, rates=rates)


def curves_csv(curves: Curves) -> str:
    """The curves as text: one line for every method, seed and bin, rates as shares."""
    rows = [
        (method, seed, f"{transitions:.0f}", *("" if np.isnan(value) else f"{value:.6g}" for value in values))
        for method, rates in curves.rates.items()
        for seed, *columns in zip(curves.seeds[method], *rates.values(), strict=True)
        for transitions, *values in zip(curves.transitions, *columns, strict=True)
    ]
    return csv_text(("method", "seed", "transitions", *MAIN_RATES.values()), rows)
