"""What a fit says that it knows and does not know, and what a training randomises after it."""

import numpy as np
import pytest

from pixel2catch.identification.encoders import Encoders
from pixel2catch.identification.fit import SERVO_PARAMETERS, Fit
from pixel2catch.identification.identify import LAG, RATIOS, estimates, gain_ranges
from pixel2catch.identification.intervals import model_covariance
from pixel2catch.identification.report_tables import weak_directions
from pixel2catch.mdp.dynamics_file import GainRanges
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

JOINTS = ("elbow_joint", "wrist_3_joint", "index_joint_1")
PERFECT = Encoders.perfect(1, 1)
SCALE = np.array((1.0, 1.0, 1.0, 1.0, 0.0))
ONLY_FRICTION = np.array((0.0, 0.0, 1.0, 0.0, 0.0))
ONLY_LATENCY = np.array((0.0, 0.0, 0.0, 0.0, 1.0))
DAMPING_FOR_LATENCY = np.array((0.0, 1.0, 0.0, 0.0, -1.0))


def fit_of(covariance: np.ndarray, free: tuple[str, ...] = ("stiffness", "damping", "armature")) -> Fit:
    """A fit of these covariances, one of each joint."""
    dynamics = JointDynamics.nominal(JOINTS[: len(covariance)])
    return Fit(
        dynamics=dynamics,
        free=free,
        covariance=covariance,
        prior=2.0,
        encoders=PERFECT,
        encoder_deviations=PERFECT,
    )


def fit_with(*directions: np.ndarray) -> Fit:
    """A fit with standard deviations of 0.01, but for one direction of each joint."""
    covariance = [1e-4 * np.eye(5) + np.outer(direction, direction) for direction in directions]
    return fit_of(np.stack(covariance), SERVO_PARAMETERS)


def test_well_known_joints_have_no_weak_direction():
    fit = fit_with(0.0 * SCALE, 0.0 * SCALE)
    assert weak_directions(fit) == ()
    known = estimates(fit)
    np.testing.assert_allclose([known[name].half_width for name in fit.free], 0.0196)


def test_common_scale_is_named_and_its_ratios_are_known():
    fit = fit_with(0.0 * SCALE, 0.4 * SCALE)
    (weak,) = weak_directions(fit)
    assert weak.joint == "wrist_3_joint"
    assert weak.is_scale
    assert set(weak.parameters) == {"stiffness", "damping", "frictionloss", "armature"}
    assert weak.half_width == pytest.approx(1.96 * 0.8, rel=1e-3)
    assert "share one scale: only their ratios are known" in weak.meaning
    assert "fix stiffness" in weak.proposal
    lag = estimates(fit)[LAG]
    assert lag.value[1] == pytest.approx(202.0 / 2066.0)
    np.testing.assert_allclose(lag.half_width, 1.96 * 0.01 * np.sqrt(2))


def test_lone_and_opposed_parameters_are_named():
    friction, opposed, latency = sorted(
        weak_directions(fit_with(ONLY_FRICTION, 0.9 * DAMPING_FOR_LATENCY, 0.1 * ONLY_LATENCY)),
        key=lambda weak: JOINTS.index(weak.joint),
    )
    assert friction.meaning == "frictionloss of elbow_joint is known to a factor of 7.1 only"
    assert "slow reversals" in friction.proposal
    assert not opposed.is_scale
    assert set(opposed.parameters) == {"damping", "latency"}
    assert "stand in for each other" in opposed.meaning
    assert latency.meaning == "latency of index_joint_1 is known to 2.0 ms only"


def test_parameters_that_were_not_fitted_have_no_ratio():
    known = estimates(fit_of(fit_with(SCALE).covariance[:, 4:, 4:], ("latency",)))
    assert not known.keys() & RATIOS.keys()


PAPER = GainRanges().of(UR5E_ALLEGRO)
ELBOW, WRIST, INDEX = 2, 5, 6
GAINS = ("stiffness", "damping", "armature")
TOGETHER = np.ones(3)


def about_one(half_width: float) -> tuple[float, float]:
    return float(np.exp(-half_width)), float(np.exp(half_width))


def test_a_well_known_joint_gets_narrow_ranges_drawn_apart():
    """Intervals of ±0.098 %, less than what is always left: 2 %."""
    ranges = gain_ranges(fit_of(np.stack([2.5e-7 * np.eye(3)])), PAPER)
    np.testing.assert_allclose(ranges.stiffness_scale[ELBOW], about_one(0.02))
    np.testing.assert_allclose(ranges.damping_scale[ELBOW], about_one(0.02))
    assert not any(ranges.is_damping_relative)


def test_where_only_the_ratio_is_known_the_scale_keeps_the_papers_range():
    """A common scale known to a factor 7: the stiffness is the paper's, the damping ±1.96 · 0.01 √2 of it."""
    ranges = gain_ranges(fit_of(np.stack([1e-4 * np.eye(3) + np.outer(TOGETHER, TOGETHER)])), PAPER)
    assert ranges.stiffness_scale[ELBOW] == (0.8, 1.2)
    np.testing.assert_allclose(ranges.damping_scale[ELBOW], about_one(1.96 * 0.01 * 2**0.5))
    assert ranges.is_damping_relative[ELBOW]


def test_a_half_known_scale_is_drawn_in_its_interval():
    covariance = 1e-4 * np.eye(3) + 0.05**2 * np.outer(TOGETHER, TOGETHER)
    ranges = gain_ranges(fit_of(np.stack([covariance] * 3)), PAPER)
    for row in (ELBOW, WRIST, INDEX):
        np.testing.assert_allclose(ranges.stiffness_scale[row], about_one(1.96 * np.hypot(0.05, 0.01)))
        assert ranges.is_damping_relative[row]


def test_what_nothing_is_known_of_keeps_the_papers_ranges():
    assert gain_ranges(fit_of(np.stack([4.0 * np.eye(3)] * 3)), PAPER) == PAPER
    assert gain_ranges(fit_of(np.stack([1e-4 * np.eye(1)]), ("latency",)), PAPER) == PAPER


def test_damping_fitted_at_an_assumed_stiffness_is_relative_to_it():
    ranges = gain_ranges(fit_of(np.stack([0.03**2 * np.eye(1)]), ("damping",)), PAPER)
    assert ranges.stiffness_scale[ELBOW] == (0.8, 1.2)
    np.testing.assert_allclose(ranges.damping_scale[ELBOW], about_one(1.96 * 0.03))
    assert ranges.is_damping_relative[ELBOW]


def test_stiffness_fitted_at_an_assumed_damping_is_drawn_apart():
    ranges = gain_ranges(fit_of(np.stack([0.03**2 * np.eye(1)]), ("stiffness",)), PAPER)
    np.testing.assert_allclose(ranges.stiffness_scale[ELBOW], about_one(1.96 * 0.03))
    assert ranges.damping_scale == PAPER.damping_scale
    assert not any(ranges.is_damping_relative)


def test_ranges_of_other_joints_stay():
    """What an earlier fit of the elbow narrowed is not widened by one of the wrist and the index finger."""
    earlier = gain_ranges(fit_of(np.stack([2.5e-7 * np.eye(3)])), PAPER)
    wrist = Fit(
        dynamics=JointDynamics.nominal(JOINTS[1:]),
        free=GAINS,
        covariance=np.stack([2.5e-7 * np.eye(3)] * 2),
        prior=2.0,
        encoders=PERFECT,
        encoder_deviations=PERFECT,
    )
    both = gain_ranges(wrist, earlier)
    assert both.stiffness_scale[ELBOW] == earlier.stiffness_scale[ELBOW]
    assert both.stiffness_scale[WRIST] == both.stiffness_scale[ELBOW]
    latency = fit_of(np.stack([1e-4 * np.eye(1)]), ("latency",))
    assert gain_ranges(latency, earlier) == earlier


def test_a_new_fit_may_know_less_than_an_earlier_one():
    earlier = gain_ranges(fit_of(np.stack([2.5e-7 * np.eye(3)])), PAPER)
    assert gain_ranges(fit_of(np.stack([4.0 * np.eye(3)])), earlier) == PAPER


def test_the_armature_of_a_stiff_joint_is_no_better_known_than_its_servo_s_cycle() -> None:
    """0.4 ms of 200 N·m·s/rad are 0.08 kg·m², 40 % of an armature of 0.2, and of its servo's torques.

    Links as heavy as that double the scale's 15 %, and add 15 % of their own.
    """
    joint = JointDynamics.nominal(["elbow_joint"]).with_values(damping=200.0, armature=0.2)
    alone, heavy = (
        model_covariance(joint, joint.armature, np.array([inertia]), ("stiffness", "armature"), 0.01)[0]
        for inertia in (0.0, 0.2)
    )
    assert alone[1, 1] == pytest.approx(0.4**2 + 0.15**2)
    assert heavy[1, 1] == pytest.approx(0.4**2 + 0.3**2 + 0.15**2)
    assert alone[0, 0] == pytest.approx(0.4**2 + 0.15**2)
    assert heavy[0, 0] == pytest.approx(0.2**2 + 0.15**2)


def test_the_lag_is_no_better_known_than_it_is_of_another_robot() -> None:
    """Damping over stiffness to 0.3 %, whatever the common scale of both is known to."""
    joint, free = JointDynamics.nominal(["elbow_joint"]), ("stiffness", "damping")
    (covariance,) = model_covariance(joint, joint.armature, np.array([0.2]), free, 0.01)
    difference = np.array((-1.0, 1.0))
    assert difference @ covariance @ difference == pytest.approx(0.003**2)
