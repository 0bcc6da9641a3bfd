import csv
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_up import plan, write_study
from numpy import ndarray

from pixel2catch.evaluation.comparison import figures
from pixel2catch.evaluation.comparison.plan import ComparisonFolder
from pixel2catch.evaluation.comparison.summary import Columns, all_curves, binned, curves_csv, gather
from pixel2catch.methods import METHODS


def log(transitions: list[float], episodes: list[float], rate: list[float]) -> Columns:
    columns = [np.array(values, dtype=float) for values in (transitions, episodes, rate, rate)]
    return dict(zip(("transitions", "episodes", "tracking_rate", "success_rate"), columns, strict=True))


def bins(columns: Columns, *edges: float) -> ndarray:
    return binned(columns, "success_rate", np.array(edges, dtype=float))


def test_a_bin_is_the_rate_of_its_episodes():
    """0.5 of 10 and 1.0 of 30 episodes: 35 of 40."""
    columns = log([1, 2, 11], [10, 30, 4], [0.5, 1.0, 0.25])
    assert bins(columns, 0, 10, 20).tolist() == [0.875, 0.25]


def test_updates_without_episodes_count_for_nothing():
    columns = log([1, 2], [0, 8], [float("nan"), 0.5])
    assert bins(columns, 0, 10).tolist() == [0.5]


def test_gaps_are_interpolated_and_nothing_is_extrapolated():
    columns = log([15, 35], [1, 1], [0.2, 0.6])
    assert bins(columns, 0, 10, 20, 30, 40, 50) == pytest.approx([np.nan, 0.2, 0.4, 0.6, np.nan], nan_ok=True)


def test_no_episode_at_all():
    assert np.isnan(bins(log([5], [0], [float("nan")]), 0, 10)).all()


def test_constant_rates_stay_constant():
    """Binning invents no value: whatever the grid, a constant is a constant."""
    columns = log(list(np.linspace(1, 1000, 777)), [3.0] * 777, [0.37] * 777)
    curves = gather({"proposed": {0: columns}})
    assert curves.rates["proposed"]["success_rate"] == pytest.approx(np.full((1, 60), 0.37))


def test_mean_and_deviation_over_seeds_by_hand():
    """0.2 and 0.4: mean 0.3, sample deviation 0.1414; where one seed has nothing yet, there is no mean."""
    logs = {0: log([5, 15], [1, 1], [0.2, 0.5]), 1: log([5], [1], [0.4])}
    mean, deviation = gather({"proposed": logs}).mean_and_deviation("proposed", "success_rate")
    assert mean == pytest.approx([0.3, np.nan], nan_ok=True)
    assert deviation == pytest.approx([0.141421, np.nan], nan_ok=True, abs=1e-6)


def test_curves_of_a_study(tmp_path: Path):
    curves = all_curves(write_study(tmp_path), plan())
    assert curves is not None
    assert curves.edges.tolist() == [0, 100, 200, 300]
    assert curves.seeds == {"only_wh": (0, 1), "proposed": (0, 1)}
    rows = list(csv.DictReader(io.StringIO(curves_csv(curves))))
    assert len(rows) == 2 * 2 * 3
    last = {(row["method"], row["seed"]): row["success_rate"] for row in rows if row["transitions"] == "250"}
    assert last["proposed", "1"] == "0.275"  # 0.2 of 10 and 0.3 of 30 episodes, as the last bin is closed


def test_a_study_without_logs_has_no_curves(tmp_path: Path):
    assert all_curves(ComparisonFolder(tmp_path), plan()) is None


@pytest.mark.parametrize("drawn", [figures.look, figures.line])
def test_no_two_methods_look_alike(drawn: Callable[[str], dict]):
    assert len({str(drawn(method)) for method in METHODS}) == len(METHODS)
