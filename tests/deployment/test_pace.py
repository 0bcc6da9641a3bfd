"""Decisions come as regularly as images, but for the slowest looks."""

import numpy as np
import pytest

from pixel2catch.deployment.pace import QUANTILE, STEP, Pace
from pixel2catch.robot.constants import CONTROL_DT


def test_first_looks_wait_for_nothing_and_count_as_little_as_others():
    pace = Pace(longest=0.05)
    for _ in range(5):
        assert pace.moment(1.0, 1.5) < 1.5
    assert pace.age == pytest.approx(5 * QUANTILE * STEP)


def test_a_quicker_look_waits_and_a_slower_one_does_not():
    pace = Pace(longest=0.05)
    for _ in range(100):
        pace.moment(1.0, 1.03)
    assert pace.moment(2.0, 2.02) == pytest.approx(2.03, abs=2 * STEP)
    assert pace.moment(3.0, 3.04) < 3.04


def test_so_many_looks_are_in_time_and_steps_are_even():
    """Of looks that take 26 to 34 ms at random, nine of ten wait; steps vary by a fifth of what they did."""
    rng, pace = np.random.default_rng(0), Pace(longest=0.05)
    stamps = CONTROL_DT * np.arange(3000)
    done = stamps + rng.uniform(0.026, 0.034, len(stamps))
    decided = np.array([max(pace.moment(*image), image[1]) for image in zip(stamps, done, strict=True)])
    assert QUANTILE < np.mean(done[500:] < decided[500:]) < QUANTILE + 0.05  # it adapts before it waits
    assert np.diff(decided[500:]).std() < 0.2 * np.diff(done[500:]).std()


def test_it_follows_a_machine_that_becomes_slower_or_faster():
    pace = Pace(longest=0.05)
    for age, num in ((0.03, 100), (0.04, 40), (0.02, 500)):
        for _ in range(num):
            pace.moment(0.0, age)
        assert pace.age == pytest.approx(age, abs=2 * STEP)


def test_nobody_waits_longer_than_costs_nothing():
    pace = Pace(longest=0.05)
    for _ in range(1000):
        pace.moment(0.0, 0.2)
    assert pace.age == 0.05
