"""Motion of commands: exact braking, limits, and arrival without overshoot."""

from dataclasses import replace
from math import sqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import ruckig
from hypothesis import given, settings
from hypothesis import strategies as st

from paper_robot import JOINTS
from pixel2catch.robots.geometry import travel_columns
from pixel2catch.servo.laws import (
    braked_position,
    braked_speed,
    limited_speed,
    moving_mean,
    speed_to,
    stopping_speed,
)
from pixel2catch.servo.limits import JointLimits, ServoLimits, motion_columns, records
from pixel2catch.servo.link import Clamp, Mode
from pixel2catch.servo.tick import target_speed
from pixel2catch.workcells import find_workcell

DT, ACCELERATION, JERK = 0.002, np.array([200.0, 50.0]), np.array([40e3, 20e3])
ENDLESS = travel_columns(JOINTS[:2], ACCELERATION, DT)
MOTION = {"speed": [8.0, 2.0], **motion_columns(ACCELERATION, JERK, DT), **ENDLESS}
LIMITS = records(lower=[-1.0, -0.5], upper=[1.0, 2.0], acceleration=ACCELERATION, jerk=JERK, **MOTION)
FAST, SLOW = BOTH = LIMITS.view(np.recarray)


def test_braking_by_hand():
    """From 1 rad/s with 0.4 rad/s less in each tick: 0.6, 0.2, 0 rad/s for 2 ms each."""
    position, velocity, path = 0.1, -1.0, [braked_position(0.1, -1.0, ticks, FAST) for ticks in (1, 2, 3, 50)]
    np.testing.assert_allclose(path, 0.1 - 0.002 * np.array([0.6, 0.8, 0.8, 0.8]), atol=1e-15)
    for left in (0.6, 0.2, 0.0, 0.0):
        velocity = braked_speed(velocity, FAST)
        position += velocity * DT
        assert velocity == pytest.approx(-left, abs=1e-15)
    assert position == pytest.approx(path[-1], abs=1e-15)


@given(st.floats(0.0, 3.0))
def test_the_stopping_speed_stops_exactly_at_the_distance(distance: float):
    for limits in BOTH:
        speed = stopping_speed(distance, limits)
        assert braked_position(speed * DT, speed, 10_000, limits) == pytest.approx(distance, abs=1e-12)


def test_a_command_is_the_mean_of_positions():
    """Accelerations of 200 and -200 rad/s² must be 10 ms apart at 40,000 rad/s³; of ±50 rad/s² 5 ms."""
    assert LIMITS["window"].tolist() == [5, 3]
    np.testing.assert_allclose(LIMITS["delay"], [0.004, 0.002])
    for limits, positions, mean in (
        (FAST, [0.0, 6.0, 2.0, 3.0, 4.0], 4.0),
        (SLOW, [6.0, 8.0, 1.0, 5.0], 5.0),
    ):
        recent = np.array(positions)
        assert moving_mean(recent, 5.0 if limits is FAST else 9.0, limits) == pytest.approx(mean)
        assert recent.tolist() == [*positions[1:], 5.0 if limits is FAST else 9.0]


@pytest.mark.parametrize("joint", [0, 1])
def test_no_request_exceeds_a_limit(joint: int):
    """The mean of the positions keeps position, speed, acceleration and jerk."""
    random, limits = np.random.default_rng(joint), BOTH[joint]
    start = (0.9, -0.4)[joint]
    for _ in range(20):
        position, velocity, recent, commands = start, 0.0, np.full(5, start), [start] * 4
        for requested in random.choice([-1e9, -3.0, 0.0, 0.5, 3.0, 1e9], 300):
            velocity = limited_speed(position, velocity, requested, limits)
            position += velocity * DT
            commands.append(moving_mean(recent, position, limits))
        for order, name in enumerate(("speed", "acceleration", "jerk"), start=1):
            reached = np.abs(np.diff(commands, n=order)).max() / DT**order / limits[name]
            assert reached <= 1.0 + 1e-6, name
            assert order == 1 or reached >= 0.7, name
        assert limits.lower - 1e-12 <= min(commands)
        assert max(commands) <= limits.upper + 1e-12


@pytest.mark.parametrize("joint", [0, 1])
def test_a_goal_is_reached_without_overshoot(joint: int):
    limits = BOTH[joint]
    for goal in np.random.default_rng(1).uniform(limits.lower, limits.upper, 20):
        position = velocity = 0.0
        for _ in range(600):
            velocity = limited_speed(position, velocity, speed_to(position, goal, limits), limits)
            assert (goal - position) * (goal - position - velocity * DT) >= -1e-15
            position += velocity * DT
        assert position == pytest.approx(goal, abs=1e-12)
        assert velocity == pytest.approx(0.0, abs=1e-9)


@given(st.floats(0.02, 1.0), st.sampled_from([0, 1]))
def test_a_motion_to_a_goal_is_time_optimal_up_to_two_ticks(distance: float, joint: int):
    limits: Any = BOTH[joint : joint + 1].copy()
    limits.lower, limits.upper = -2.0, 2.0
    limits = limits[0]
    position = velocity = command = 0.0
    recent, ticks = np.zeros(limits.window), 0
    while abs(command - distance) > 1e-9:
        velocity = limited_speed(position, velocity, speed_to(position, distance, limits), limits)
        position += velocity * DT
        command, ticks = moving_mean(recent, position, limits), ticks + 1
    asked, trajectory = ruckig.InputParameter(1), ruckig.Trajectory(1)
    asked.target_position = [distance]
    asked.max_velocity, asked.max_acceleration = [limits.speed], [limits.acceleration]
    asked.max_jerk = [limits.jerk]
    ruckig.Ruckig(1).calculate(asked, trajectory)
    assert abs(ticks * DT - trajectory.duration) < 2.0 * DT


@settings(max_examples=15)
@given(
    st.floats(0.5, 40.0), st.floats(0.02, 1.0), st.floats(2.0, 50.0), st.sampled_from([0.001, 0.002, 1 / 240])
)
def test_near_an_end_a_command_is_no_faster_than_the_interface_allows(deceleration, offset, acceleration, dt):
    """And brakes within its own acceleration, though the interface may expect more."""
    joint = replace(JOINTS[0], travel=(-0.3, 0.3, deceleration, offset))
    columns = travel_columns([joint], np.array([acceleration]), dt)
    limits = SimpleNamespace(**{name: float(each[0]) for name, each in columns.items()}, speed=3.0)
    limits.change, limits.bend, limits.lower, limits.upper = (
        acceleration * dt,
        acceleration * dt**2,
        -2.0,
        2.0,
    )
    position, velocity = 0.0, 0.0
    for side in (1.0, -1.0):
        for _ in range(round(0.7 / dt)):
            before, velocity = velocity, limited_speed(position, velocity, 9.0 * side, limits)
            position += velocity * dt
            allowed = sqrt(2.0 * deceleration * (0.3 - side * position)) - offset
            assert side * velocity <= max(allowed, 0.0)
            assert abs(velocity - before) <= acceleration * dt * (1.0 + 1e-9)


def test_a_joint_that_brakes_slowly_reaches_its_even_speed():
    """A joint of the FR3 in steady motion, its command ahead by the lag: a far target does not slow it.

    Commands are no faster than joints may be; where they may be faster, the lead alone limits joints.
    """
    workcell = find_workcell("fr3_allegro")
    joints = JointLimits.of(workcell, is_identified=False)
    limit = ServoLimits.of(workcell, joints).joint_records.view(np.recarray)[0]
    joint = SimpleNamespace(hold=0.0, start=0.0, end=1.0, stamp=0.0, joint_pos=0.0, is_lag_estimated=True)
    joint.lag, joint.position = limit.lag, limit.lag * limit.even_speed
    robot = SimpleNamespace(mode=Mode.RUN, now=0.0, target_begun=-1.0, clamped=0)
    assert target_speed(robot, joint, limit) == pytest.approx(limit.even_speed, rel=0.01)
    assert robot.clamped == Clamp.LEAD
