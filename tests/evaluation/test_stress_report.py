"""Tables, picture and order of the methods, from results worked out by hand."""

from pathlib import Path
from typing import Any

import pytest

from pixel2catch.errors import UnknownNameError
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.evaluation.stress.measuring import PolicyEntry, plan_results
from pixel2catch.evaluation.stress.report import (
    REAL_ROBOT,
    SHOWN,
    as_csv,
    as_markdown,
    compare_orders,
    heatmap,
    make_table,
)
from pixel2catch.evaluation.stress.suite import select_settings

SURE = {method: (rate / 100 - 0.01, rate / 100 + 0.01) for method, rate in REAL_ROBOT.items()}


def rates(successes: int, trials: int = 200) -> dict[str, Any]:
    interval = list(wilson_interval(successes, trials))
    shown = {name: successes / trials for name in SHOWN}
    return {"trials": trials, **shown, **{f"{name}_interval": interval for name in SHOWN}}


def table(successes: dict[str, list[int]], *axes: str, task: str = "nominal") -> dict[str, Any]:
    """Successes by method, setting by setting."""
    policies = [PolicyEntry(name=f"{m}-seed0", folder=Path("."), method=m, task=task) for m in successes]
    results = plan_results(policies, select_settings(axes), Path("out"))
    rows = zip(*successes.values(), strict=True)
    return make_table(results, [{"metrics": rates(number)} for row in rows for number in row])


def test_the_same_order():
    order = compare_orders({method: [rate] for method, rate in REAL_ROBOT.items()}, SURE)
    assert order is not None
    assert order.tau == pytest.approx(1.0)
    assert (order.num_settled, order.simulated) == (10, order.real)
    assert "agrees with" in order.sentence()


def test_two_neighbours_exchanged():
    """One of ten pairs is the other way round: tau = (9 - 1) / 10."""
    swapped = {**REAL_ROBOT, "proposed": 41.0, "object_position": 52.0}
    order = compare_orders({method: [rate] for method, rate in swapped.items()}, SURE)
    assert order is not None
    assert order.tau == pytest.approx(0.8)
    assert order.simulated[:2] == ("object_position", "proposed")
    assert "does not agree" in order.sentence()


def test_equal_rates_are_no_order_and_intervals_may_overlap():
    order = compare_orders(
        {"proposed": [0.5], "only_wh": [0.5]}, {"proposed": (0.4, 0.6), "only_wh": (0.5, 0.7)}
    )
    assert order is not None
    assert (order.tau, order.num_settled) == (0.0, 0)
    assert "does not agree" in order.sentence()


def test_methods_that_the_robot_never_tried_do_not_count():
    assert compare_orders({"proposed": [0.9], "without_pf": [0.1]}, SURE) is None


def test_several_policies_of_a_method_count_by_their_mean():
    order = compare_orders({"proposed": [0.2, 0.4], "only_wh": [0.35]}, SURE)
    assert order is not None
    assert order.simulated == ("only_wh", "proposed")


def test_a_table_by_hand():
    """Means over two settings; 180 of 200 is 90.0 % with the interval 85 to 93."""
    report = table({"proposed": [180, 20], "only_wh": [10, 0]}, "nominal", "edge_noise")
    assert report["mean"] == {"proposed-seed0": 0.5, "only_wh-seed0": 0.025}
    text = as_markdown(report)
    assert "| nominal | 90.0 [85, 93] | 5.0 [3, 9] |" in text
    assert "| **mean over settings** | 50.0 | 2.5 |" in text
    lines = as_csv(report).splitlines()
    assert len(lines) == 1 + 4
    assert lines[1].startswith("nominal,nominal,,,proposed-seed0,proposed,true,200,0.90000,0.85")


def test_what_a_policy_was_not_trained_on_is_marked():
    """Camera mount: not in the nominal task, but in the wide one; edge noise in neither."""
    rows = {"proposed": [180, 180, 180, 180, 180]}
    for task, mount in (("nominal", False), ("wide", True)):
        report = table(rows, "edge_noise", "together", task=task)
        marks = {
            name: row["rates"]["proposed-seed0"]["is_trained_on"] for name, row in report["settings"].items()
        }
        assert (marks["edge_noise-10"], marks["together-camera_mount"]) == (False, mount)
        text = as_markdown(report)
        assert r"| edge noise 10 px | 90.0 [85, 93] \* |" in text
        assert ("| together camera mount | 90.0 [85, 93] |" in text) == mount
        assert f"proposed,{str(mount).lower()},200" in as_csv(report).splitlines()[2]


def test_an_unknown_task_is_named():
    with pytest.raises(UnknownNameError, match="wide"):
        table({"proposed": [180]}, "nominal", task="widest")


def test_the_order_is_that_of_the_setting_closest_to_reality():
    """Camera mount, detector, flight, reality: only the last counts."""
    report = table({"proposed": [0, 0, 0, 150], "object_position": [190, 190, 190, 90]}, "together")
    assert report["reality"]["simulated"] == ("proposed", "object_position")
    assert report["reality"]["real_success_percent"] == {"proposed": 52.8, "object_position": 41.9}
    assert "agrees" in as_markdown(report)


def test_the_picture_grows_with_the_table():
    def size(data: bytes) -> tuple[int, int]:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")

    small = size(heatmap(table({"proposed": [180, 20]}, "nominal", "edge_noise")))
    large = size(heatmap(table({"proposed": [9, 8, 7, 6], "only_wh": [0, 1, 2, 3]}, "together")))
    assert large[0] > small[0]
    assert large[1] > small[1]
