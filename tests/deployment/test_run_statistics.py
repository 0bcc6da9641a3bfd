"""Durations of a deployment, against percentiles of NumPy."""

from typing import Any

import numpy as np
import pytest

from pixel2catch.cli.deploy import summary_lines
from pixel2catch.deployment.statistics import BIN, LONGEST, PERCENTAGES, Histogram, RunStatistics
from pixel2catch.servo.link import Command


def test_percentiles_are_as_fine_as_the_bins_and_a_long_duration_is_counted():
    histogram, durations = Histogram(), np.random.default_rng(0).gamma(4.0, 6e-3, 3000)
    assert histogram.milliseconds(50) is None
    for duration in durations.tolist():
        histogram.count(duration)
    values = histogram.milliseconds(*PERCENTAGES)
    assert values is not None
    for percentage in PERCENTAGES:
        exact = 1e3 * np.percentile(durations, percentage, method="inverted_cdf")
        assert values[f"p{percentage}"] == pytest.approx(exact, abs=1e3 * BIN)
    assert (values["max"], values["count"]) == (1e3 * durations.max(), 3000)
    (long := Histogram()).count(3.0 * LONGEST)
    assert long.milliseconds(50) == {"p50": 3e3 * LONGEST, "max": 3e3 * LONGEST, "count": 1}


def test_the_ages_of_an_image_at_each_stage_are_in_the_summary():
    statistics = RunStatistics()
    ages = {"exposed": 0.0, "received": 0.017, "begun": 0.018, "perceived": 0.024}
    for number in range(10):
        stamp = 1.0 + number / 30
        times = {name: stamp + age for name, age in ages.items()}
        statistics.count_step(stamp + 0.025, stamp + 0.026, times, is_decided=True)
    stages = statistics.summary()["stages_ms"]
    assert {name: values["p50"] for name, values in stages.items()} == pytest.approx(
        {"received": 17.0, "begun": 18.0, "perceived": 24.0, "decided": 26.0}
    )


def test_a_tick_is_late_after_two_periods_of_the_servo():
    """3 ms between two commands: late at 1,000 Hz, not at 500 Hz."""
    command: dict[str, Any] = {"joint_pos_command": np.zeros(1), "joint_pos": np.zeros(1)}
    command |= dict.fromkeys(("target_stamp", "image_stamp", "duration"), 0.0)
    command |= dict.fromkeys(("mode", "stopped_by", "found", "refused", "clamped"), 0)
    for tick, num_late in ((0.001, 1), (0.002, 0)):
        statistics = RunStatistics(tick=tick)
        for time in (1.0, 1.003):
            statistics.note_command(Command(time=time, **command))
        assert statistics.num_late_ticks == num_late


def test_a_summary_has_reasons_in_words_and_no_control_characters():
    statistics = RunStatistics()
    statistics.stops["dead man, image stale"] = 2
    statistics.clamps["acceleration"] = 30
    statistics.refused_prompts["\x1b[2Jprogram\u202e"] = 1
    lines = "\n".join(summary_lines(statistics.summary()))
    assert "stopped 2 x: the dead-man's switch is not held; no image for 0.1 s" in lines
    assert "acceleration" not in lines  # limits change commands in every throw: only in --json
    assert "\ufffd[2Jprogram\ufffd: 1 x" in lines
