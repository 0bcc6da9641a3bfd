"""Motion of commands: exact braking, limits, and arrival without overshoot."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pixel2catch.servo.motion import Motion, MotionLimits, braked, fastest, towards, wished

LIMITS = MotionLimits(
    lower=np.array([-1.0, -0.5]),
    upper=np.array([1.0, 2.0]),
    speed=np.array([8.0, 2.0]),
    acceleration=np.array([200.0, 50.0]),
    dt=0.002,
)
CHANGE = LIMITS.acceleration * LIMITS.dt


def at(position: tuple[float, float], velocity: tuple[float, float] = (0.0, 0.0)) -> Motion:
    return Motion(position=np.array([position]), velocity=np.array([velocity]))


def test_braking_by_hand():
    """From 1 rad/s with 0.4 rad/s less in each tick: 0.6, 0.2, 0 rad/s for 2 ms each."""
    for ticks, covered, left in ((1, 0.6, 0.6), (2, 0.8, 0.2), (3, 0.8, 0.0), (50, 0.8, 0.0)):
        after = braked(at((0.1, 0.0), (-1.0, 0.0)), LIMITS, np.array([[ticks]]))
        np.testing.assert_allclose(after.position[0, 0], 0.1 - 0.002 * covered, atol=1e-15)
        np.testing.assert_allclose(after.velocity[0, 0], -left, atol=1e-15)


@given(st.floats(0.0, 3.0))
def test_the_fastest_speed_stops_just_in_the_distance(distance: float):
    speed = fastest(np.full((1, 2), distance), LIMITS)
    end = braked(Motion(position=speed * LIMITS.dt, velocity=speed), LIMITS, np.array([[10_000]]))
    np.testing.assert_allclose(end.position, distance, atol=1e-12)
    np.testing.assert_allclose(end.velocity, 0.0, atol=1e-9)


def test_no_wish_breaks_a_limit():
    random = np.random.default_rng(0)
    motion = Motion(position=np.tile((0.9, -0.4), (500, 1)), velocity=np.zeros((500, 2)))
    for _ in range(500):
        wish = random.choice([-1e9, -3.0, 0.0, 0.5, 3.0, 1e9], motion.position.shape)
        after = towards(motion, wish, LIMITS)
        assert (np.abs(after.velocity) <= LIMITS.speed + 1e-12).all()
        assert (np.abs(after.velocity - motion.velocity) <= CHANGE + 1e-12).all()
        assert ((after.position >= LIMITS.lower - 1e-12) & (after.position <= LIMITS.upper + 1e-12)).all()
        np.testing.assert_allclose(after.position, motion.position + after.velocity * LIMITS.dt, atol=1e-15)
        motion = after


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
