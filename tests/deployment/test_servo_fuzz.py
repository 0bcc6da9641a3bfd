"""No command exceeds a limit, for any inputs."""

from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from chaos import Chaos
from hypothesis import given, settings
from hypothesis import strategies as st
from laws import Laws
from mishaps import MISHAPS, one
from servo_rows import LIMITS, Lab

from paper_robot import JOINTS
from pixel2catch.servo.link import Clamp, Fault, Mode
from pixel2catch.servo.tick import ServoCore, ServoState


def watched(num_rows: int, num_ticks: int, seed: int) -> Laws:
    """Check `num_rows * num_ticks` ticks of random inputs."""
    core, state = ServoCore(LIMITS), ServoState.idle(num_rows, LIMITS)
    chaos, laws = Chaos(num_rows, LIMITS, seed), Laws(num_rows, LIMITS)
    for _ in range(num_ticks):
        inputs = chaos.inputs()
        state = output = core.tick(state, inputs)
        laws.check(inputs, output)
        chaos.follow(output["sent"])
    return laws


def check_that_everything_happened(laws: Laws) -> None:
    assert laws.ticks_in.min() > 100, laws.ticks_in
    assert laws.ticks_in[Mode.RUN] > 0.1 * laws.ticks_in.sum(), laws.ticks_in
    assert laws.num_clamps == sum(Clamp)
    assert min(laws.reached.values()) > 0.99, laws.reached
    never_stops = {Fault.START_POSE, Fault.WORKSPACE, Fault.STILL_STOPPING, Fault.SWITCH_NOT_PRESSED}
    never_seen = {fault for fault, number in laws.stops_by.items() if number == 0}
    slow = {Fault.JOINTS_FROZEN, Fault.JOINT_SPEED}  # other faults are found earlier
    assert never_seen - slow == never_stops
    assert all(laws.refusals_by[fault] for fault in never_stops)


def watch(lab: Lab, laws: Laws, num_ticks: int, mishap: int | None = None) -> None:
    for _ in range(num_ticks):
        output = lab.tick(None if mishap is None else one(mishap))
        laws.check(lab.last_inputs, output)


@cache
def running() -> tuple[Lab, Laws]:
    lab, laws = Lab(), Laws(1, LIMITS)
    watch(lab, laws, 1)
    output = lab.request_arm()
    laws.check(lab.last_inputs, output)
    watch(lab, laws, 80)
    return lab, laws


@settings(max_examples=8)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([None, *range(len(MISHAPS))]),
            st.lists(st.floats(), min_size=len(JOINTS), max_size=len(JOINTS)),
            st.integers(1, 20),
        ),
        max_size=4,
    )
)
def test_no_sequence_of_faults_breaks_a_law(story: list[tuple[int | None, list[float], int]]):
    """Some ticks each with own targets and at most one fault; then the robot can be armed again."""
    lab, laws = deepcopy(running())
    for mishap, target, num_ticks in story:
        lab.target = np.array([target])
        watch(lab, laws, num_ticks, mishap)
    lab.target = lab.joint_pos.copy()
    watch(lab, laws, 230)
    assert lab.request_arm()["mode"] in (Mode.ARMED, Mode.RUN)


def test_no_law_is_broken_in_two_hundred_thousand_ticks():
    check_that_everything_happened(watched(num_rows=1000, num_ticks=200, seed=0))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_no_law_is_broken_in_two_million_ticks(seed: int):
    check_that_everything_happened(watched(num_rows=1000, num_ticks=1000, seed=seed))
