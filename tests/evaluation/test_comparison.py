"""Comparisons: plan, rows, curves and report of made-up results, and an earlier study."""

import json
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from pixel2catch.errors import StudyError
from pixel2catch.evaluation.comparison import (
    GROUPS,
    Columns,
    ComparisonFolder,
    Plan,
    Training,
    all_curves,
    binned,
    difference_rows,
    learning_curves,
    pooled,
    quality_table,
    rates_table,
    summary_rows,
    write_comparison,
)
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.files import read_json_object
from pixel2catch.methods import PROPOSED
from pixel2catch.policy import Policy, contract_of

EARLIER = Path(__file__).parents[2] / "experiments" / "results"
SESSION = {"started": "2026-01-01T00:00:00+00:00", "command": "pixel2catch reproduce --seeds 2"}
RATES = ("tracking_rate", "success_rate", "palm_contact_rate", "verified_hold_rate")
LABELS = ("method", "objects", "paper")
RUN = Training(method="proposed", seed=0)


def plan(**changes: Any) -> Plan:
    given: dict[str, Any] = (
        {"methods": ("only_wh", "proposed"), "seeds": 2, "configuration": {"training lr": 0.1}}
        | {"sessions": (SESSION,)}
        | changes
    )
    return Plan(**given)


def rates(successes: int, trials: int) -> dict[str, Any]:
    """All four rates alike."""
    result: dict[str, Any] = {"trials": trials}
    for name in RATES:
        interval = list(wilson_interval(successes, trials))
        result |= {name: successes / trials, f"{name}_interval": interval}
    return result


def write_evaluation(folder: ComparisonFolder, run: Training, group: str, successes: int) -> None:
    result = rates(successes, 100) | {
        "max_joint_speed": 2.0 + run.seed,
        "max_torque_share": 0.5,
        "max_penetration": 0.004,
    }
    path = folder.evaluation(run, group)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result))


def write_training(folder: ComparisonFolder, run: Training, seconds: float = 60.0) -> None:
    folder.run(run).mkdir(parents=True)
    summary = {"status": "finished", "transitions": 300, "seconds": seconds}
    (folder.run(run) / "summary.json").write_text(json.dumps(summary))
    rows = ("100,0,nan,nan", "200,10,0.5,0.2", f"300,30,0.{5 + run.seed},0.{2 + run.seed}")
    text = "\n".join(("transitions,episodes,tracking_rate,success_rate", *rows)) + "\n"
    folder.metrics(run).write_text(text)


@pytest.fixture
def study(tmp_path: Path) -> ComparisonFolder:
    """Two methods with two seeds: 20 and 40 of 100 throws are caught, the same for all."""
    folder = ComparisonFolder(tmp_path)
    folder.open(plan())
    for run in plan().runs():
        write_training(folder, run, seconds=60.0 * (1 + run.seed))
        for group in GROUPS:
            write_evaluation(folder, run, group, successes=20 * (1 + run.seed))
    return folder


def test_every_method_has_one_seed_before_any_has_two():
    names = [run.name for run in plan().runs()]
    assert names == ["only_wh-seed0", "proposed-seed0", "only_wh-seed1", "proposed-seed1"]


def test_methods_and_seeds_may_be_added_and_nothing_else(study: ComparisonFolder):
    study.open(plan(methods=("single_agent",), seeds=3))
    methods = ("only_wh", "proposed", "single_agent")
    assert study.plan() == plan(methods=methods, seeds=3, sessions=(SESSION, SESSION))
    before = (study.path / "study.json").read_bytes()
    with pytest.raises(StudyError, match=r"training lr: 0\.1 in the study, 0\.2 now"):
        study.open(plan(configuration={"training lr": 0.2}))
    assert (study.path / "study.json").read_bytes() == before


@pytest.mark.parametrize("content", [None, "{"])
def test_results_without_a_readable_study_are_left_alone(content: str | None, study: ComparisonFolder):
    (study.path / "study.json").unlink()
    if content:
        (study.path / "study.json").write_text(content)
    with pytest.raises(StudyError, match=r"study\.json"):
        study.open(plan())


@pytest.mark.parametrize("content", ["{", json.dumps({"status": "interrupted"})])
def test_only_a_finished_training_is_done(content: str, study: ComparisonFolder):
    assert study.is_trained(RUN)
    (study.run(RUN) / "summary.json").write_text(content)
    assert not study.is_trained(RUN)


def test_a_training_without_its_folder_is_done_if_its_policy_is_evaluated(study: ComparisonFolder):
    study.run(RUN).rename(study.path / "elsewhere")
    assert study.is_trained(RUN)
    study.evaluation(RUN, "unseen").unlink()
    assert not study.is_trained(RUN)


def test_a_result_counts_for_its_own_policy_only(study: ComparisonFolder):
    assert study.result(RUN, "seen") is not None
    torch.manual_seed(0)
    Policy(contract_of(PROPOSED), hidden=(4,)).save(study.run(RUN) / "policy")
    assert study.result(RUN, "seen") is None


def test_pooled_by_hand():
    """20 of 100 and 40 of 100: mean 0.3, deviation sqrt(2 * 0.1²) = 0.1414, interval of 60 of 200."""
    result = pooled([rates(20, 100), rates(40, 100)], "success_rate")
    assert result["mean"] == pytest.approx(0.3)
    assert result["deviation"] == pytest.approx(0.141421, abs=1e-6)
    assert result["interval"] == pytest.approx([0.2407, 0.3668], abs=1e-4)
    assert result["values"] == [0.2, 0.4]
    uneven = pooled([rates(1, 10), rates(90, 100)], "success_rate")
    assert uneven["interval"] == list(wilson_interval(91, 110))
    assert pooled([rates(1, 10)], "success_rate")["deviation"] is None


def test_rates_stand_beside_the_paper(study: ComparisonFolder):
    rows = list(summary_rows(study, plan()))
    assert rates_table(rows)[2] == {
        "method": "proposed",
        "objects": "seen",
        "seeds": "2",
        "T.R. [%]": "30.0 ± 14.1",
        "T.R., 95 % interval": "[24.1, 36.7]",
        "T.R., paper": "89.97 ± 0.21",
        "S.R. [%]": "30.0 ± 14.1",
        "S.R., 95 % interval": "[24.1, 36.7]",
        "S.R., paper": "84.13 ± 0.50",
    }
    quality = quality_table(rows)[0]
    assert [quality[name] for name in ("trials", "largest joint speed [rad/s]")] == ["200", "3.00"]
    assert quality["deepest penetration [mm]"] == "4.0"
    assert rows[2]["success_rate"]["interval"][0] == pytest.approx(0.24074, abs=1e-5)
    assert rows[2]["paper"]["success_rate"]["mean"] == 0.8413


def test_differences_of_a_sweep_are_in_one_thing(tmp_path: Path):
    methods = ("only_wh", *(f"{name} epochs={each}" for name in ("only_wh", "proposed") for each in (1, 2)))
    folder, swept = ComparisonFolder(tmp_path), plan(methods=methods)
    for run in swept.runs():
        write_evaluation(folder, run, "seen", successes=20)
    pairs = [row["pair"] for row in difference_rows([*summary_rows(folder, swept)])]
    assert pairs == [
        "only_wh - only_wh epochs=1",
        "only_wh - only_wh epochs=2",
        "only_wh epochs=1 - only_wh epochs=2",
        "only_wh epochs=1 - proposed epochs=1",
        "only_wh epochs=2 - proposed epochs=2",
        "proposed epochs=1 - proposed epochs=2",
    ]


def test_missing_results_have_no_row_and_missing_numbers_a_dash(study: ComparisonFolder):
    for seed in (0, 1):
        study.evaluation(Training(method="proposed", seed=seed), "unseen").unlink()
    study.evaluation(Training(method="only_wh", seed=1), "seen").unlink()
    rows = {(row["method"], row["objects"]): row for row in summary_rows(study, plan())}
    assert ("proposed", "unseen") not in rows
    assert rates_table([rows["only_wh", "seen"]])[0]["S.R. [%]"] == "20.0 ± \N{EN DASH}"
    write_evaluation(study, Training(method="object_position", seed=0), "seen", successes=5)
    (row,) = summary_rows(study, plan(methods=("object_position",)))
    assert rates_table([row])[0]["S.R., paper"] == "\N{EN DASH}"


def log(transitions: list[float], episodes: list[float], rate: list[float]) -> Columns:
    columns = [np.array(values, dtype=float) for values in (transitions, episodes, rate, rate)]
    return dict(zip(("transitions", "episodes", "tracking_rate", "success_rate"), columns, strict=True))


@pytest.mark.parametrize(
    ("columns", "edges", "expected"),
    [
        (log([1, 2, 11], [10, 30, 4], [0.5, 1.0, 0.25]), (0, 10, 20), [0.875, 0.25]),  # 35 of 40 episodes
        (log([1, 2], [0, 8], [np.nan, 0.5]), (0, 10), [0.5]),
        (log([15, 35], [1, 1], [0.2, 0.6]), (0, 10, 20, 30, 40, 50), [np.nan, 0.2, 0.4, 0.6, np.nan]),
        (log([5], [0], [np.nan]), (0, 10), [np.nan]),
    ],
)
def test_bins_by_hand(columns: Columns, edges: tuple[float, ...], expected: list[float]):
    """Of the episodes in a bin; gaps are interpolated, the ends stay empty."""
    found = binned(columns, "success_rate", np.array(edges, dtype=float))
    assert found == pytest.approx(expected, nan_ok=True)


def test_mean_and_deviation_over_seeds_by_hand():
    """0.2 and 0.4: mean 0.3, sample deviation 0.1414; where one seed has nothing yet, there is no mean."""
    logs = [log([5, 15], [1, 1], [0.2, 0.5]), log([5], [1], [0.4])]
    _, curves = learning_curves({"proposed": logs})
    mean, deviation = curves["proposed"]["success_rate"]
    assert mean == pytest.approx([0.3, np.nan], nan_ok=True)
    assert deviation == pytest.approx([0.141421, np.nan], nan_ok=True, abs=1e-6)


def test_report_of_a_whole_study(study: ComparisonFolder):
    write_comparison(study)
    report = study.path / "report"
    assert {path.name for path in report.iterdir()} == {"table.md", "table.json", "curves.png"}
    with Image.open(report / "curves.png") as picture:
        assert 800 <= picture.width <= 1600
        assert len(picture.convert("RGB").resize((64, 64)).getcolors(4096) or ()) > 20
    text = (report / "table.md").read_text()
    assert "curves.png" in text
    assert "| training lr | 0.1 |" in text
    data = read_json_object(report / "table.json")
    assert data["results"][2]["success_rate"]["values"] == [0.2, 0.4]
    assert data["sessions"] == [SESSION]


def test_report_of_a_study_that_has_just_begun(tmp_path: Path):
    folder = ComparisonFolder(tmp_path)
    with pytest.raises(StudyError, match=r"no study\.json"):
        write_comparison(folder)
    folder.open(plan())
    assert all_curves(folder, plan()) is None
    assert write_comparison(folder) == []
    write_training(folder, replace(RUN, seed=1))
    write_comparison(folder)
    assert (tmp_path / "report" / "curves.png").exists()


def test_an_earlier_study_is_read(tmp_path: Path):
    """Its results are those that it was reported with."""
    copytree(EARLIER / "2026-11-29-critic", tmp_path / "study")
    table = tmp_path / "study" / "report" / "table.json"
    shown = read_json_object(table)["results"]
    write_comparison(ComparisonFolder(tmp_path / "study"))
    again = read_json_object(table)["results"]
    for before, now in zip(shown, again, strict=True):
        assert {name: now[name] for name in LABELS} == {name: before[name] for name in LABELS}
        for name in ("success_rate", "verified_hold_rate"):
            assert now[name]["values"] == before[name]["values"]
            assert now[name]["interval"] == pytest.approx(before[name]["interval"], abs=1e-8)
