"""What a training randomises after a fit."""

import numpy as np

from pixel2catch.identification.fit import Fit
from pixel2catch.identification.identify import gain_ranges
from pixel2catch.mdp.randomization import TABLE_1_GAINS, GainRanges
from pixel2catch.robot.joint_dynamics import JointDynamics

PAPER = GainRanges()
JOINTS = ("elbow_joint", "wrist_3_joint", "index_joint_1")
ELBOW, WRIST, INDEX = 2, 5, 6
FREE = ("stiffness", "damping", "armature")
SCALE = np.ones(3)


def fit_with(covariance: np.ndarray, free: tuple[str, ...] = FREE) -> Fit:
    """A fit of these covariances, one of each joint."""
    return Fit(
        dynamics=JointDynamics.nominal(JOINTS[: len(covariance)]),
        free=free,
        covariance=covariance,
        prior=2.0,
        residual=np.zeros((10, len(covariance))),
    )


def about_one(half_width: float) -> tuple[float, float]:
    return float(np.exp(-half_width)), float(np.exp(half_width))


def test_a_well_known_joint_gets_narrow_ranges_drawn_apart():
    """Intervals of ±0.098 %, less than what is always left: 2 %."""
    ranges = gain_ranges(fit_with(np.stack([2.5e-7 * np.eye(3)])), PAPER)
    np.testing.assert_allclose(ranges.stiffness_scale[ELBOW], about_one(0.02))
    np.testing.assert_allclose(ranges.damping_scale[ELBOW], about_one(0.02))
    assert not any(ranges.is_damping_relative)


def test_where_only_the_ratio_is_known_the_scale_keeps_the_papers_range():
    """A common scale known to a factor 7: the stiffness is the paper's, the damping ±1.96 · 0.01 √2 of it."""
    ranges = gain_ranges(fit_with(np.stack([1e-4 * np.eye(3) + np.outer(SCALE, SCALE)])), PAPER)
    assert ranges.stiffness_scale[ELBOW] == (0.8, 1.2)
    np.testing.assert_allclose(ranges.damping_scale[ELBOW], about_one(1.96 * 0.01 * 2**0.5))
    assert ranges.is_damping_relative[ELBOW]


def test_a_half_known_scale_is_drawn_in_its_interval():
    covariance = 1e-4 * np.eye(3) + 0.05**2 * np.outer(SCALE, SCALE)
    ranges = gain_ranges(fit_with(np.stack([covariance] * 3)), PAPER)
    for row in (ELBOW, WRIST, INDEX):
        np.testing.assert_allclose(ranges.stiffness_scale[row], about_one(1.96 * np.hypot(0.05, 0.01)))
        assert ranges.is_damping_relative[row]


def test_what_nothing_is_known_of_keeps_the_papers_ranges():
    assert gain_ranges(fit_with(np.stack([4.0 * np.eye(3)] * 3)), PAPER) == PAPER
    assert gain_ranges(fit_with(np.stack([1e-4 * np.eye(1)]), ("latency",)), PAPER) == PAPER


def test_damping_fitted_at_an_assumed_stiffness_is_relative_to_it():
    ranges = gain_ranges(fit_with(np.stack([0.03**2 * np.eye(1)]), ("damping",)), PAPER)
    assert ranges.stiffness_scale[ELBOW] == (0.8, 1.2)
    np.testing.assert_allclose(ranges.damping_scale[ELBOW], about_one(1.96 * 0.03))
    assert ranges.is_damping_relative[ELBOW]


def test_stiffness_fitted_at_an_assumed_damping_is_drawn_apart():
    ranges = gain_ranges(fit_with(np.stack([0.03**2 * np.eye(1)]), ("stiffness",)), PAPER)
    np.testing.assert_allclose(ranges.stiffness_scale[ELBOW], about_one(1.96 * 0.03))
    assert ranges.damping_scale == TABLE_1_GAINS
    assert not any(ranges.is_damping_relative)


def test_ranges_of_other_joints_stay():
    """What an earlier fit of the elbow narrowed is not widened by one of the wrist and the index finger."""
    earlier = gain_ranges(fit_with(np.stack([2.5e-7 * np.eye(3)])), PAPER)
    wrist = Fit(
        dynamics=JointDynamics.nominal(JOINTS[1:]),
        free=FREE,
        covariance=np.stack([2.5e-7 * np.eye(3)] * 2),
        prior=2.0,
        residual=np.zeros((10, 2)),
    )
    both = gain_ranges(wrist, earlier)
    assert both.stiffness_scale[ELBOW] == earlier.stiffness_scale[ELBOW]
    assert both.stiffness_scale[WRIST] == both.stiffness_scale[ELBOW]
    latency = fit_with(np.stack([1e-4 * np.eye(1)]), ("latency",))
    assert gain_ranges(latency, earlier) == earlier


def test_a_new_fit_may_know_less_than_an_earlier_one():
    earlier = gain_ranges(fit_with(np.stack([2.5e-7 * np.eye(3)])), PAPER)
    assert gain_ranges(fit_with(np.stack([4.0 * np.eye(3)])), earlier) == PAPER
