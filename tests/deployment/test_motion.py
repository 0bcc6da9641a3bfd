"""Motion of commands: exact braking, limits, and arrival without overshoot."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.servo.motion import (
    Motion,
    MotionLimits,
    averaged,
    braked,
    braking,
    fastest,
    towards,
    wished,
)

LIMITS = MotionLimits(
    lower=np.array([-1.0, -0.5]),
    upper=np.array([1.0, 2.0]),
    speed=np.array([8.0, 2.0]),
    acceleration=np.array([200.0, 50.0]),
    jerk=np.array([40e3, 20e3]),
    dt=0.002,
)
CHANGE = LIMITS.acceleration * LIMITS.dt


def at(position: tuple[float, float], velocity: tuple[float, float] = (0.0, 0.0)) -> Motion:
    return Motion(position=np.array([position]), velocity=np.array([velocity]))


def test_braking_by_hand():
    """From 1 rad/s with 0.4 rad/s less in each tick: 0.6, 0.2, 0 rad/s for 2 ms each."""
    motion = at((0.1, 0.0), (-1.0, 0.0))
    path = braked(motion, LIMITS, np.array([1, 2, 3, 50])[:, None, None])
    np.testing.assert_allclose(path[:, 0, 0], 0.1 - 0.002 * np.array([0.6, 0.8, 0.8, 0.8]), atol=1e-15)
    for left in (0.6, 0.2, 0.0, 0.0):
        motion = motion.moved(braking(motion, LIMITS), LIMITS.dt)
        np.testing.assert_allclose(motion.velocity[0, 0], -left, atol=1e-15)
    np.testing.assert_allclose(motion.position, path[-1], atol=1e-15)


@given(st.floats(0.0, 3.0))
def test_the_fastest_speed_stops_just_in_the_distance(distance: float):
    speed = fastest(np.full((1, 2), distance), LIMITS)
    end = braked(Motion(position=speed * LIMITS.dt, velocity=speed), LIMITS, np.array([[[10_000]]]))
    np.testing.assert_allclose(end, distance, atol=1e-12)


def test_a_command_is_the_mean_of_as_many_positions_as_its_jerk_asks_for():
    """Accelerations of 200 and -200 rad/s² must be 10 ms apart at 40,000 rad/s³; of ±50 rad/s² 5 ms."""
    assert LIMITS.window.tolist() == [5, 3]
    np.testing.assert_allclose(LIMITS.delay, [0.004, 0.002])
    positions = np.array([[6.0, 6.0], [2.0, 8.0], [3.0, 1.0], [4.0, 5.0], [5.0, 9.0]])[:, None]
    np.testing.assert_allclose(averaged(positions, LIMITS), [[4.0, 5.0]])


def test_a_jerk_without_a_limit_needs_no_mean():
    free = replace(LIMITS, jerk=np.full(2, np.inf))
    assert free.window.tolist() == [1, 1]
    np.testing.assert_array_equal(averaged(np.ones((1, 4, 2)), free), np.ones((4, 2)))


def test_no_wish_breaks_a_limit():
    """Neither that of a motion, nor that of the commands which are its means."""
    random = np.random.default_rng(0)
    start = np.tile((0.9, -0.4), (500, 1))
    motion = Motion(position=start, velocity=np.zeros((500, 2)))
    recent, commands = np.tile(start, (5, 1, 1)), [start] * 4
    for _ in range(500):
        wish = random.choice([-1e9, -3.0, 0.0, 0.5, 3.0, 1e9], motion.position.shape)
        after = towards(motion, wish, LIMITS)
        np.testing.assert_allclose(after.position, motion.position + after.velocity * LIMITS.dt, atol=1e-15)
        recent = np.concatenate((recent[1:], after.position[None]))
        commands.append(averaged(recent, LIMITS))
        motion = after
    for order, limit in enumerate((LIMITS.speed, LIMITS.acceleration, LIMITS.jerk), start=1):
        reached = np.abs(np.diff(commands, n=order, axis=0)).max(axis=(0, 1)) / LIMITS.dt**order
        assert (reached <= limit * (1.0 + 1e-6)).all(), order
        assert order == 1 or (reached >= 0.7 * limit).all(), order
    positions = np.array(commands)
    assert ((positions >= LIMITS.lower - 1e-12) & (positions <= LIMITS.upper + 1e-12)).all()


def test_a_goal_is_reached_and_never_passed():
    goal = np.random.default_rng(1).uniform(LIMITS.lower, LIMITS.upper, (500, 2))
    motion = Motion(position=np.zeros_like(goal), velocity=np.zeros_like(goal))
    for _ in range(600):
        after = towards(motion, wished(motion, goal, LIMITS), LIMITS)
        assert ((goal - motion.position) * (goal - after.position) >= -1e-15).all()
        motion = after
    np.testing.assert_allclose(motion.position, goal, atol=1e-12)
    np.testing.assert_allclose(motion.velocity, 0.0, atol=1e-9)


def test_the_time_to_a_goal_is_the_shortest():
    """0.5 rad at up to 8 rad/s and 200 rad/s²: 40 ms up, 40 ms down, and 22.5 ms between."""
    motion, goal, ticks = at((0.0, 0.0)), np.array([[0.5, 0.0]]), 0
    while abs(motion.position[0, 0] - 0.5) > 1e-9:
        motion = towards(motion, wished(motion, goal, LIMITS), LIMITS)
        ticks += 1
    assert ticks * LIMITS.dt == pytest.approx(0.1025, abs=2 * LIMITS.dt)


def test_limits_of_some_joints():
    only = LIMITS.only(slice(1, 2))
    assert (only.lower, only.upper, only.speed, only.acceleration) == (-0.5, 2.0, 2.0, 50.0)
    assert only.dt == LIMITS.dt
