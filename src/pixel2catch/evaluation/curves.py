"""Learning curves of several trainings, from their `metrics.csv`."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.result_tables import MAIN_RATES
from pixel2catch.files import read_text, reading

COLUMNS = ("transitions", "episodes", *MAIN_RATES.values())  #: Columns of `metrics.csv` for the curves.
NUM_BINS = 60  #: Most bins from the start to the end of the longest training. Source: ours.
MOST_METRICS = 2**26  #: Largest size of a `metrics.csv` [bytes]; long trainings have 100,000. Source: ours.

Columns = Mapping[str, Float[ndarray, " _"]]  #: One value for each update; trainings differ in length.


@dataclass(frozen=True, kw_only=True)
class Curves:
    """Rates in training, with the stochastic policy, in bins of transitions."""

    edges: Float[ndarray, " num_edges"]  #: Edges of the bins [transitions].
    #: By method and name of the rate, one row for each seed; NaN where a seed has no value.
    rates: dict[str, dict[str, Float[ndarray, "num_seeds num_bins"]]]

    @property
    def transitions(self) -> Float[ndarray, " num_bins"]:
        """Centres of the bins."""
        return (self.edges[1:] + self.edges[:-1]) / 2

    def mean_and_deviation(
        self, method: str, name: str
    ) -> tuple[Float[ndarray, " num_bins"], Float[ndarray, " num_bins"]]:
        """Return mean and sample deviation over seeds, where all have a value; one seed has deviation 0."""
        values = self.rates[method][name]
        several = len(values) > 1
        return values.mean(axis=0), values.std(axis=0, ddof=1) if several else np.zeros(values.shape[1])


def read_metrics(path: Path, names: Sequence[str] = COLUMNS) -> Columns:
    """Return columns of a `metrics.csv`, whose last line may be incomplete.

    Raises:
        InvalidValueError: If it cannot be read or is no such table.
    """
    with reading("metrics", path, "Train again, or take the file out of the study."):
        try:
            table = csv.DictReader(io.StringIO(read_text(path, MOST_METRICS)))
            rows = [[float(row[name] or "nan") for name in names] for row in table]
        except csv.Error as error:
            raise InvalidValueError(f"it is no table ({error})") from error
    return dict(zip(names, np.array(rows).reshape(-1, len(names)).T, strict=True))


def binned(columns: Columns, name: str, edges: Float[ndarray, " num_edges"]) -> Float[ndarray, " num_bins"]:
    """Return the rate over all episodes that ended in each bin.

    Empty bins between others are interpolated; empty bins at the ends are NaN.
    """
    has_rate = columns["episodes"] > 0
    episodes, rate = columns["episodes"][has_rate], columns[name][has_rate]
    transitions = columns["transitions"][has_rate]
    total, _ = np.histogram(transitions, edges, weights=episodes)
    events, _ = np.histogram(transitions, edges, weights=episodes * rate)
    filled = np.flatnonzero(total)
    if len(filled) == 0:
        return np.full(len(total), np.nan)
    bins = np.arange(len(total))
    return np.interp(bins, filled, events[filled] / total[filled], left=np.nan, right=np.nan)


def gather(logs: Mapping[str, Sequence[Columns]]) -> Curves:
    """Return the curves of all methods on common bins, from the metrics of the seeds of each."""
    columns = [each for seeds in logs.values() for each in seeds]
    longest = max((each["transitions"] for each in columns), key=lambda transitions: transitions[-1])
    edges = np.linspace(0.0, longest[-1], min(NUM_BINS, len(longest)) + 1)
    rates = {
        method: {
            name: np.stack([binned(each, name, edges) for each in seeds]) for name in MAIN_RATES.values()
        }
        for method, seeds in logs.items()
    }
    return Curves(edges=edges, rates=rates)
