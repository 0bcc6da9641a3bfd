"""No command exceeds a limit, for any inputs."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from chaos import Chaos
from hypothesis import given as examples
from hypothesis import settings
from hypothesis import strategies as st
from laws import Laws
from servo_rows import LIMITS, MISHAPS, Lab, given, one

from paper_robot import JOINTS
from pixel2catch.ros2.profile import MotionBudget, Profile
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.link import Clamp, Fault, Mode
from pixel2catch.servo.tick import ServoCore, ServoState
from pixel2catch.servo.workspace import Workspace
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO


def watched(num_rows: int, num_ticks: int, seed: int, limits: ServoLimits = LIMITS) -> Laws:
    core, state = ServoCore(limits), ServoState.idle(num_rows, limits)
    chaos, laws = Chaos(num_rows, limits, seed), Laws(num_rows, limits)
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
    # Other faults are found earlier.
    slow = {Fault.JOINTS_FROZEN, Fault.JOINT_SPEED, Fault.COMMANDS_IGNORED, Fault.HAND_ASTRAY}
    assert never_seen - slow == never_stops
    assert all(laws.refusals_by[fault] for fault in never_stops)


def watch(lab: Lab, laws: Laws, num_ticks: int, mishap: int | None = None) -> None:
    for _ in range(num_ticks):
        output = lab.tick(None if mishap is None else one(mishap))
        laws.check(lab.last_inputs, output)


@cache
def running(limits: ServoLimits = LIMITS) -> tuple[Lab, Laws]:
    lab, laws = Lab(limits=limits), Laws(1, limits)
    watch(lab, laws, 1)
    output = lab.request_arm()
    laws.check(lab.last_inputs, output)
    watch(lab, laws, 80)
    return lab, laws


@settings(max_examples=8)
@examples(
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


def test_no_law_is_broken_in_a_hundred_thousand_ticks():
    check_that_everything_happened(watched(num_rows=500, num_ticks=200, seed=0))


def slow_limits(dt: float) -> ServoLimits:
    """Limits of an arm with an FR3's acceleration and jerk; some joints are near the ends of their travel."""
    budget = MotionBudget(acceleration=10.0, jerk=5000.0)
    arm = replace(Profile.load("ur5e_allegro_v4").robots[0], limits=budget)
    workcell, near = replace(UR5E_ALLEGRO), UR5E_ALLEGRO.joint_names[1:4]
    vars(workcell)["joints"] = tuple(
        replace(each, travel=(each.home - 0.2, each.home + 0.2, 4.0, 0.3)) if each.name in near else each
        for each in UR5E_ALLEGRO.joints
    )
    joints, workspace = JointLimits.of(workcell, parts=(arm,)), Workspace(workcell=workcell)
    return replace(LIMITS, joints=joints, workspace=workspace, dt=dt)


@pytest.mark.parametrize("dt", [0.001, 0.002])
def test_no_law_is_broken_where_braking_takes_nearly_the_whole_stop_time(dt: float):
    limits = slow_limits(dt)
    assert (limits.joints.speed[:6] / limits.joints.acceleration[:6] > 0.28).all()
    laws = watched(120, 300, seed=3, limits=limits)
    assert laws.ticks_in[Mode.STOPPED] > 0.1 * laws.ticks_in.sum()
    assert min(laws.reached.values()) > 0.9, laws.reached


@pytest.mark.parametrize("dt", [0.001, 0.002])
def test_a_stop_ends_in_time_though_the_arm_is_dragged_on(dt: float):
    """Commands follow the joints at first, and must still brake by 10 rad/s² in what is left of 0.3 s."""
    lab, laws = running(slow_limits(dt))
    lab.is_held_fast[:6] = True
    for _ in range(round(0.4 / dt)):
        lab.joint_pos[:, :6] += 2.5 * dt * np.array((1.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        output = lab.tick(given(is_stop_requested=np.ones(1, dtype=bool)))
        laws.check(lab.last_inputs, output)
    assert Mode.STOPPED in laws.mode
