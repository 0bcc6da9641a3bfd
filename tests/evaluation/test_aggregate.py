from pathlib import Path

import pytest
from made_up import plan, rates, write_evaluation, write_study

from pixel2catch.evaluation.comparison.plan import Run
from pixel2catch.evaluation.comparison.summary import (
    mean_and_deviation,
    object_rows,
    pooled,
    summary_rows,
    training_rows,
)
from pixel2catch.evaluation.metrics import wilson_interval


def test_mean_and_sample_deviation_by_hand():
    """Mean 4 of 2, 4, 6; deviation sqrt((4 + 0 + 4) / 2) = 2."""
    assert mean_and_deviation((2.0, 4.0, 6.0)) == (4.0, 2.0)


def test_one_seed_has_no_deviation():
    assert mean_and_deviation((0.3,)) == (0.3, None)


def test_pooled_by_hand():
    """20 of 100 and 40 of 100: mean 0.3, deviation sqrt(2 * 0.1²) = 0.1414, interval of 60 of 200."""
    result = pooled([rates(20, 100), rates(40, 100)], "success_rate")
    assert result["mean"] == pytest.approx(0.3)
    assert result["deviation"] == pytest.approx(0.141421, abs=1e-6)
    assert result["interval"] == list(wilson_interval(60, 200))
    assert result["interval"] == pytest.approx([0.2407, 0.3668], abs=1e-4)
    assert result["values"] == [0.2, 0.4]


def test_pooled_interval_counts_trials_while_the_mean_counts_seeds():
    """1 of 10 and 90 of 100: the mean is 0.5, the interval that of 91 of 110."""
    result = pooled([rates(1, 10), rates(90, 100)], "success_rate")
    assert result["mean"] == pytest.approx(0.5)
    assert result["interval"] == list(wilson_interval(91, 110))


def test_summary_rows(tmp_path: Path):
    rows = list(summary_rows(write_study(tmp_path), plan()))
    keys = [(row["method"], row["objects"]) for row in rows]
    assert keys == [("only_wh", "seen"), ("only_wh", "unseen"), ("proposed", "seen"), ("proposed", "unseen")]
    assert {row["trials"] for row in rows} == {200}
    assert {row["max_joint_speed"] for row in rows} == {3.0}
    assert rows[2]["paper"] == {
        "tracking_rate": {"mean": 0.8997, "deviation": 0.0021},
        "success_rate": {"mean": 0.8413, "deviation": 0.005},
    }


def test_what_is_missing_has_no_row(tmp_path: Path):
    folder = write_study(tmp_path)
    for seed in (0, 1):
        folder.evaluation(Run(method="proposed", seed=seed), "unseen").unlink()
    folder.evaluation(Run(method="only_wh", seed=1), "seen").unlink()
    rows = {(row["method"], row["objects"]): row for row in summary_rows(folder, plan())}
    assert ("proposed", "unseen") not in rows
    assert rows["only_wh", "seen"]["seeds"] == 1
    assert rows["only_wh", "seen"]["success_rate"]["deviation"] is None


def test_a_method_that_the_paper_does_not_have(tmp_path: Path):
    folder = write_study(tmp_path)
    write_evaluation(folder, Run(method="object_position", seed=0), "seen", successes=5)
    (row,) = summary_rows(folder, plan(methods=("object_position",)))
    assert row["paper"] is None


def test_objects_pool_their_throws(tmp_path: Path):
    """20 of 50 and 40 of 50 cubes are caught: 60 of 100."""
    rows = list(object_rows(write_study(tmp_path), plan()))
    cube = next(row for row in rows if row["object"] == "cube_s")
    assert (cube["trials"], cube["success_rate"]["pooled"]) == (100, 0.6)
    assert cube["success_rate"]["interval"] == list(wilson_interval(60, 100))
    assert [row["object"] for row in rows][::2] == ["cone_l", "cube_s", "cross"]


def test_training_rows(tmp_path: Path):
    folder = write_study(tmp_path)
    (folder.run(Run(method="proposed", seed=1)) / "summary.json").unlink()
    rows = [(row["method"], row["seed"], row["seconds"]) for row in training_rows(folder, plan())]
    assert rows == [("only_wh", 0, 60.0), ("proposed", 0, 60.0), ("only_wh", 1, 120.0)]
