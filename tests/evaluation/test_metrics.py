import json
from dataclasses import replace

import pytest
import torch
from rich.console import Console
from scipy.stats import binomtest, ttest_ind

from pixel2catch.envs.episode import FAILURES, EpisodeRecord
from pixel2catch.errors import NonFiniteError
from pixel2catch.evaluation.metrics import (
    metrics,
    paired_difference,
    pooled_counts,
    welch_difference,
    wilson_interval,
)
from pixel2catch.evaluation.protocol import Trials
from pixel2catch.evaluation.report import result_tables
from pixel2catch.mdp.tensors import mapped
from pixel2catch.scene.objects import SEEN, UNSEEN
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool)


def five_trials() -> Trials:
    """Caught and verified, caught, never reached, bounced off after two steps of contact, held too late."""
    start = EpisodeRecord.start(torch.tensor([0, 1, 1, 0, 0]))
    record = replace(
        start,
        is_tracked=flags(1, 1, 0, 1, 1),
        rested_steps=torch.tensor([45, 5, 0, 0, 0]),
        is_palm_contact=flags(1, 0, 0, 1, 0),
        is_hand_contact=flags(1, 1, 0, 1, 1),
        is_dropped=flags(0, 1, 1, 1, 0),
        is_table_contact=flags(0, 0, 1, 0, 0),
        contact_steps=torch.tensor([40, 30, 0, 2, 28]),
        penetration_sum=torch.tensor([0.04, 0.03, 0.0, 0.01, 0.02]),
        max_penetration=torch.tensor([0.002, 0.004, 0.0, 0.006, 0.001]),
        is_self_contact=flags(0, 0, 1, 0, 1),
        max_object_force=torch.tensor([20.0, 50.0, 0.0, 30.0, 40.0]),
        hold_speed=torch.tensor([0.1, 0.4, 0.0, 0.0, 0.9]),
    )
    squares = torch.zeros(5, 13)
    squares[:2, 0] = torch.tensor([30.0, 1.25])  # 30 steps at the limit, 5 at a half of it
    return Trials(
        record=record,
        is_verified=flags(1, 0, 0, 0, 0),
        hold_steps=torch.tensor([45, 5, 0, 0, 0]),
        torque_squares=squares,
        limit_steps=torch.tensor([3, 0, 12, 0, 0]),
        closed_loop=torch.tensor([1, -1, 0, -1, 0]),
        is_reachable=flags(1, 1, 0, 1, 0),
    )


def test_intervals_and_p_values_are_those_of_scipy():
    for trials in (1, 2, 7, 100, 4096):
        for successes in {0, 1, trials // 3, trials // 2, trials - 1, trials}:
            test = binomtest(successes, trials)
            expected = tuple(test.proportion_ci(method="wilson"))
            assert wilson_interval(successes, trials) == pytest.approx(expected)
            failures = trials - successes
            found = paired_difference("1" * successes + "0" * failures, "0" * successes + "1" * failures)
            assert found["p_value"] == pytest.approx(test.pvalue)


def test_a_difference_of_means_is_that_of_scipy():
    values, others = (0.90, 0.95, 0.91), (0.80, 0.94, 0.85, 0.70)
    found = welch_difference(values, others)
    test = ttest_ind(values, others, equal_var=False).confidence_interval()
    assert found["difference"] == pytest.approx(0.92 - 0.8225)
    assert found["difference_interval"] == pytest.approx([test.low, test.high])
    assert welch_difference((0.5, 0.5), (0.4, 0.4))["difference_interval"] == pytest.approx([0.1, 0.1])


def test_a_paired_difference_by_hand():
    """Of ten throws one is won and three are lost: -20 points; McNemar's p is 2 (4 + 1) / 16."""
    found = paired_difference("1111110000", "0001110010")
    assert (found["lost"], found["won"], found["difference"]) == (3, 1, -0.2)
    assert found["p_value"] == pytest.approx(0.625)
    half = 1.959964 * (5 - 4 / 12) ** 0.5 / 12
    assert found["difference_interval"] == pytest.approx([-2 / 12 - half, -2 / 12 + half])
    equal = paired_difference("1101", "1101")
    assert (equal["difference"], equal["p_value"]) == (0.0, 1.0)
    assert equal["difference_interval"][0] < 0.0 < equal["difference_interval"][1]


def test_metrics_by_hand():
    result = metrics(five_trials(), UR5E_ALLEGRO)
    assert result["trials"] == 5
    assert result["tracking_rate"] == 4 / 5
    assert result["success_rate"] == 2 / 5
    assert result["palm_contact_rate"] == 2 / 5
    assert result["verified_hold_rate"] == 1 / 5
    assert (result["closed_loop_hold_rate"], result["closed_loop_hold_rate_trials"]) == (1 / 3, 3)
    assert (result["reachable_rate"], result["reachable"]["trials"]) == (3 / 5, 3)
    assert result["reachable"]["success_rate"] == 2 / 3
    closed = {"closed_loop_hold_rate": 0.5, "trials": 2}
    assert pooled_counts([result, closed], "closed_loop_hold_rate") == (2, 5)
    assert result["table_contact_rate"] == 1 / 5
    assert result["self_contact_rate"] == 2 / 5
    assert result["mean_penetration"] == pytest.approx(0.10 / 100)
    assert result["max_penetration"] == pytest.approx(0.006)
    assert result["success_rate_interval"] == list(wilson_interval(2, 5))
    failures = {"never_reached": 1 / 5, "bounced_off": 1 / 5, "dropped": 0.0, "not_held": 1 / 5}
    assert result["failures"] == {name: failures[name] for name in FAILURES}
    objects = result["objects"]
    assert {name: rates["trials"] for name, rates in objects.items()} == {"cone_s": 3, "cone_l": 2}
    assert (objects["cone_l"]["success_rate"], objects["cone_s"]["tracking_rate"]) == (1 / 2, 1.0)
    assert result["hold_speed"] == pytest.approx(0.25)  # of the two successes
    assert (result["median_object_force"], result["max_object_force"]) == (30.0, 50.0)  # 20, 30, 40, 50 N
    assert result["arm_limit_time"] == pytest.approx(15 / 30 / 5)
    assert result["hold_torque"]["index_joint_1"] == pytest.approx((31.25 / 50) ** 0.5)


def test_metrics_without_contact_are_valid_json():
    missed = mapped(lambda values: values[2:3], five_trials())
    result = metrics(replace(missed, is_reachable=flags(1)), UR5E_ALLEGRO)
    assert (result["reachable_rate"], "reachable" in result) == (1.0, False)
    unreachable = metrics(replace(missed, is_reachable=flags(0)), UR5E_ALLEGRO) | {"objects_thrown": []}
    rates, *_ = result_tables({"seen": unreachable}, "proposed")
    assert [str([*column.cells][1]) for column in rates.columns[:2]] == ["  reachable", "0"]
    assert [result[name] for name in ("hold_speed", "hold_torque", "median_object_force")] == [None] * 3
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_divergence_is_an_error():
    trials = five_trials()
    broken = replace(trials.record, max_joint_speed=torch.tensor([0.0, 1.0, float("nan"), 0.0, 0.0]))
    with pytest.raises(NonFiniteError, match="max_joint_speed"):
        metrics(replace(trials, record=broken), UR5E_ALLEGRO)


def shown(*tables: object) -> str:
    console = Console(width=110, highlight=False)
    with console.capture() as capture:
        for table in tables:
            console.print(table)
    return capture.get()


def test_tables_show_rates_beside_the_papers_objects_and_failures():
    """Objects that the paper did not throw have no row of it."""
    result = metrics(five_trials(), UR5E_ALLEGRO)
    results = {"seen": result | {"objects_thrown": SEEN}, "unseen": result | {"objects_thrown": UNSEEN}}
    text = shown(*result_tables(results, "proposed"))
    for number in ("40.0 [12-77]", "89.97 ± 0.21", "84.13 ± 0.50", "89.28 ± 0.79", "84.83 ± 1.17"):
        assert number in text
    rates, objects, quality = result_tables({"cube": result | {"objects_thrown": ["cube_s"]}}, "proposed")
    assert "±" not in shown(rates).split("seeds")[-1]
    assert "cone_l" in shown(objects)
    for value in ("never reached", "6.0 mm", "0.250 rad/s", "79.1 % (index_joint_1)", "0.10 s", "50.0 N"):
        assert value in shown(quality)
