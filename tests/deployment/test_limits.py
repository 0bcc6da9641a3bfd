"""Limits of the servo: numbers by hand, and invalid ones."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from paper_robot import JOINTS
from pixel2catch.errors import InvalidValueError
from pixel2catch.ros2.profile import MotionBudget, Profile
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.workcells import find_workcell
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO


def test_numbers_by_hand():
    """Pan: damping over stiffness 342 / 2504 s; its lead makes 0.9 of 2.79253 rad/s."""
    limits = JointLimits.of(UR5E_ALLEGRO)
    assert limits.lag[0] == pytest.approx(0.13658, abs=1e-5)
    assert limits.lead[0] == pytest.approx(0.34327, abs=1e-5)
    assert limits.tracking_error[0] == pytest.approx(0.25745, abs=1e-5)
    assert np.isinf(limits.tracking_error[6:]).all()
    assert (limits.upper[1], limits.lower[1]) == pytest.approx((2 * pi - 0.05, 0.05 - 2 * pi))
    assert (limits.upper[2], limits.lower[2]) == pytest.approx((pi - 0.05, 0.05 - pi))
    for joint in (0, 4, 5, 9, 15):
        assert (limits.lower[joint], limits.upper[joint]) == (JOINTS[joint].lower, JOINTS[joint].upper)


def test_half_of_the_speed():
    """Lead and accelerations are halved; without identified dynamics commands are as fast as joints."""
    full, half = JointLimits.of(UR5E_ALLEGRO), JointLimits.of(UR5E_ALLEGRO, 0.5)
    for name in ("speed", "acceleration", "jerk", "lead", "tracking_error"):
        np.testing.assert_allclose(getattr(half, name), 0.5 * getattr(full, name))
    joints = JointLimits.of(UR5E_ALLEGRO, 0.5, is_identified=False)
    np.testing.assert_allclose(joints.speed, [0.5 * 0.9 * joint.velocity_limit for joint in JOINTS])


def test_no_step_is_larger_than_ur_accepts():
    """UR ignores steps above 0.04 rad in 2 ms, at any rate at which commands are sent."""
    for dt in (0.002, 0.004, 0.01):
        limits = replace(ServoLimits.of(UR5E_ALLEGRO), dt=dt)
        assert (limits.joint_records["speed"][:6] * dt < 0.04).all()


def test_each_arm_and_hand_begins_and_ends_once():
    """Whether a driver ignores commands is found for each arm."""
    limits = ServoLimits.of(find_workcell("two_ur5e_allegro")).joint_records
    assert np.flatnonzero(limits["is_first"]).tolist() == [0, 6, 19, 25]
    assert np.flatnonzero(limits["is_last"]).tolist() == [5, 18, 24, 37]


def test_invalid_limits_are_refused():
    for share in (0.0, 1.01, np.nan):
        with pytest.raises(InvalidValueError, match="share"):
            JointLimits.of(UR5E_ALLEGRO, share)
    limits = JointLimits.of(UR5E_ALLEGRO)
    with pytest.raises(InvalidValueError, match="acceleration"):
        replace(limits, acceleration=0.0 * limits.acceleration)
    with pytest.raises(InvalidValueError, match="lower"):
        replace(limits, lower=limits.upper)
    slow = replace(limits, acceleration=0.0 * limits.acceleration + 40.0)
    weak = replace(limits, deceleration=0.4 * limits.deceleration)
    for joints, seconds in ((slow, "0.502"), (weak, "0.314")):
        with pytest.raises(InvalidValueError, match=f"a stop takes a joint up to {seconds} s"):
            ServoLimits.of(UR5E_ALLEGRO, joints)


def test_a_budget_lowers_only_the_limits_of_its_part():
    """2 of 2.79253 rad/s: commands and lead in that proportion, and a share of the speed on top of it."""
    own, arm = JointLimits.of(UR5E_ALLEGRO), Profile.load("ur5e_allegro_v4").robots[0]
    budget = replace(arm, limits=MotionBudget(speed=2.0, acceleration=150.0, jerk=2e4))
    lower = JointLimits.of(UR5E_ALLEGRO, 0.5, parts=(budget,))
    np.testing.assert_allclose(lower.lead[:6], own.lead[:6] * 0.5 * 2.0 / 2.79253)
    np.testing.assert_allclose(lower.speed[:6], 0.5 * 2.0 / 2.79253 * 10.0)
    np.testing.assert_allclose(lower.joint_speed[:6], 1.0 + 0.15 * 2.79253)
    assert (lower.acceleration[:6] == 150.0).all()
    assert (lower.jerk[:6] == 2e4).all()
    assert (lower.deceleration[:6] == 20.0).all()
    np.testing.assert_array_equal(lower.deceleration[6:], own.deceleration[6:])
    for name in ("acceleration", "jerk"):
        np.testing.assert_array_equal(getattr(lower, name)[6:], 0.5 * getattr(own, name)[6:])
    np.testing.assert_allclose(lower.speed[6:], 10.0)
    words = ServoLimits.of(UR5E_ALLEGRO, lower).in_words(np.arange(6))
    assert words == (
        "joints up to 1 rad/s; commands up to 3.58 rad/s, 150 rad/s², 20000 rad/s³; a stop takes 0.05 s"
    )


def test_commands_may_be_slower_than_their_joints_and_as_often_as_the_driver_takes_them():
    """An FR3's interface: 10 rad/s² and 2 ms of averaging leave 2.86 rad/s for a stop in 0.3 s."""
    fr3 = Profile.load("fr3_allegro")
    workcell, arm = find_workcell(fr3.workcell), fr3.robots[0]
    wider = replace(arm, limits=replace(arm.limits, command_speed=np.inf))
    for parts, most in (((arm,), 2.62), ((wider,), 10.0 * (0.3 - 0.004 - 0.01))):
        limits = ServoLimits.of(workcell, JointLimits.of(workcell, parts=parts), parts)
        assert limits.dt == 0.001
        assert limits.joint_records["speed"][:7] == pytest.approx(most)
        assert limits.joints.acceleration[0] == 10.0
        assert limits.joints.jerk[0] == 5000.0
