import time

import pytest

from pixel2catch.perception.extractor import MEMORY, StageClock


def test_percentiles_are_those_of_the_durations():
    clock = StageClock()
    for _ in range(20):
        with clock.stage("nap"):
            time.sleep(0.002)
    nap = clock.percentiles()["nap"]
    assert nap.count == 20
    assert 0.002 <= nap.p50 <= nap.p95 <= nap.p99 < 1.0


def test_stages_nest_and_the_outer_takes_longer():
    clock = StageClock()
    with clock.stage("outer"), clock.stage("inner"):
        time.sleep(0.001)
    report = clock.percentiles()
    assert list(report) == ["inner", "outer"]
    assert report["outer"].p50 >= report["inner"].p50


def test_a_stage_that_fails_is_measured():
    clock = StageClock()
    with pytest.raises(ZeroDivisionError), clock.stage("broken"):
        _ = 1 // 0
    assert clock.percentiles()["broken"].count == 1


def test_memory_is_bounded():
    clock = StageClock()
    for _ in range(MEMORY + 10):
        with clock.stage("nothing"):
            pass
    assert clock.percentiles()["nothing"].count == MEMORY
