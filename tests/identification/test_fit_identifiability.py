"""What a fit says that it does not know."""

import numpy as np
import pytest

from pixel2catch.identification.fit import SERVO_PARAMETERS, Fit
from pixel2catch.identification.identify import half_widths, ratios
from pixel2catch.identification.report_tables import weak_directions
from pixel2catch.robot.joint_dynamics import JointDynamics

JOINTS = ("elbow_joint", "wrist_3_joint", "index_joint_1")
SCALE = np.array((1.0, 1.0, 1.0, 1.0, 0.0))
ONLY_FRICTION = np.array((0.0, 0.0, 1.0, 0.0, 0.0))
ONLY_LATENCY = np.array((0.0, 0.0, 0.0, 0.0, 1.0))
DAMPING_FOR_LATENCY = np.array((0.0, 1.0, 0.0, 0.0, -1.0))


def fit_with(*directions: np.ndarray) -> Fit:
    """A fit with standard deviations of 0.01, but for one direction of each joint."""
    covariance = [1e-4 * np.eye(5) + np.outer(direction, direction) for direction in directions]
    return Fit(
        dynamics=JointDynamics.nominal(JOINTS[: len(directions)]),
        free=SERVO_PARAMETERS,
        covariance=np.stack(covariance),
        prior=2.0,
        residual=np.zeros((10, len(directions))),
    )


def test_well_known_joints_have_no_weak_direction():
    fit = fit_with(0.0 * SCALE, 0.0 * SCALE)
    assert weak_directions(fit) == ()
    np.testing.assert_allclose(half_widths(fit), 0.0196)


def test_common_scale_is_named_and_its_ratios_are_known():
    fit = fit_with(0.0 * SCALE, 0.4 * SCALE)
    (weak,) = weak_directions(fit)
    assert weak.joint == "wrist_3_joint"
    assert weak.is_scale
    assert set(weak.parameters) == {"stiffness", "damping", "frictionloss", "armature"}
    assert weak.half_width == pytest.approx(1.96 * 0.8, rel=1e-3)
    assert "share one scale: only their ratios are known" in weak.meaning
    assert "fix stiffness" in weak.proposal
    lag = ratios(fit)[0]
    assert lag.name == "damping / stiffness"
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
    full = fit_with(SCALE)
    fit = Fit(
        dynamics=full.dynamics,
        free=("latency",),
        covariance=full.covariance[:, 4:, 4:],
        prior=2.0,
        residual=full.residual,
    )
    assert ratios(fit) == ()
