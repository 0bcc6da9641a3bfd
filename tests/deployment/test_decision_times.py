"""Decisions come as regularly as images, but for the slowest looks."""

import numpy as np
import pytest

from pixel2catch.deployment.control_loop import GRACE, SHIFT, DecisionTimer
from pixel2catch.scene.constants import CONTROL_DT


def decided(timer: DecisionTimer, ends: list[tuple[float, float]], until: float, step: float) -> np.ndarray:
    """Times of decisions by a loop that looks at the clock this often, given stamps and ends of looks [s]."""
    waiting, times, now = list(ends), list[float](), 0.0
    while now < until:
        now += step
        while waiting and waiting[0][1] <= now:
            timer.learn(waiting[0][0], now)
            waiting.pop(0)
        if now >= timer.due:
            times.append(now)
            timer.advance(now, is_even=True)
    return np.array(times)


@pytest.mark.parametrize(("least", "jitter", "every"), [(0.02, 0.0, 1), (0.02, 0.01, 1), (0.075, 0.01, 2)])
def test_decisions_are_even_and_most_looks_are_done_just_before(least: float, jitter: float, every: int):
    """Whether a look takes less than a control step, or more and every second image is looked at."""
    rng = np.random.default_rng(0)
    stamps = every * CONTROL_DT * np.arange(300)
    ends = stamps + least + rng.uniform(0.0, jitter, len(stamps))
    times = decided(DecisionTimer(0.01), list(zip(stamps, ends, strict=True)), stamps[-1], 1e-4)
    gaps = np.diff(times[100:])
    assert len(times) == pytest.approx(stamps[-1] / CONTROL_DT, abs=2)
    assert gaps.mean() == pytest.approx(CONTROL_DT, rel=2e-3)
    assert np.abs(gaps - CONTROL_DT).max() < SHIFT + 2e-4
    later = [times[times >= end].min() - end for end in ends[150:-10]]
    assert np.quantile(later, 0.8) < jitter + 3e-3


def test_a_look_that_should_be_done_is_waited_for_but_not_for_long():
    timer, age = DecisionTimer(0.0), 0.02
    for number in range(60):
        timer.learn(number * CONTROL_DT, number * CONTROL_DT + age)
    timer.advance(59 * CONTROL_DT + age, is_even=False)
    due, stamp = timer.due, timer.due - age
    assert timer.is_due(due, None)
    assert not timer.is_due(due + 0.9 * GRACE, stamp)
    assert timer.is_due(due + GRACE, stamp)
    assert timer.is_due(due, stamp + 0.5 * CONTROL_DT)  # which is not expected to be done


def test_without_images_decisions_go_on_and_late_ones_are_left_out():
    timer = DecisionTimer(1.0)
    timer.advance(1.001, is_even=False)
    assert timer.due == pytest.approx(1.0 + CONTROL_DT)
    timer.advance(1.0 + 3.5 * CONTROL_DT, is_even=True)
    assert timer.due == pytest.approx(1.0 + 4.0 * CONTROL_DT, abs=SHIFT)


def test_before_the_first_orders_a_step_may_be_of_any_length():
    timer = DecisionTimer(1.0)
    timer.learn(0.99, 1.005)
    timer.advance(1.0, is_even=False)
    assert timer.due == pytest.approx(1.005 + CONTROL_DT, abs=1e-6)
    timer.learn(1.02, 1.06)
    before = timer.due
    timer.advance(timer.due, is_even=True)
    assert abs(timer.due - before - CONTROL_DT) == pytest.approx(SHIFT)
