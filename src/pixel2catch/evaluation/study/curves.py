"""Learning curves of several seeds on a common grid."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.evaluation.study.plan import Plan, Run, StudyFolder
from pixel2catch.evaluation.tables import MAIN_RATES

NUM_BINS = 60
"""Most bins from the start to the end of the longest training. Source: ours."""

Columns = Mapping[str, Float[ndarray, " num_updates"]]


@dataclass(frozen=True, kw_only=True)
class Curves:
    """Rates in training, with the stochastic policy, in bins of transitions.

    Attributes:
        edges: Edges of the bins [transitions].
        seeds: By method, the seeds that there are.
        rates: By method and name of the rate, one row a seed; NaN where a seed has no value.
    """

    edges: Float[ndarray, " num_edges"]
    seeds: dict[str, tuple[int, ...]]
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


def read_metrics(path: Path) -> Columns:
    """The columns of a `metrics.csv` that curves are made of."""
    names = ("transitions", "episodes", *MAIN_RATES.values())
    with open(path, newline="", encoding="utf-8") as file:
        rows = [[float(row[name] or "nan") for name in names] for row in csv.DictReader(file)]
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


def study_curves(folder: StudyFolder, plan: Plan) -> Curves | None:
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
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("method", "seed", "transitions", *MAIN_RATES.values()))
    for method, rates in curves.rates.items():
        for seed, *columns in zip(curves.seeds[method], *rates.values(), strict=True):
            for transitions, *values in zip(curves.transitions, *columns, strict=True):
                shown = ("" if np.isnan(value) else f"{value:.6g}" for value in values)
                writer.writerow((method, seed, f"{transitions:.0f}", *shown))
    return text.getvalue()
