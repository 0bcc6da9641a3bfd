"""Joint dynamics as data, and the exact step of the command filter."""

import numpy as np

from pixel2catch.robots.joint_dynamics import PARAMETERS, JointDynamics
from pixel2catch.robots.ur5e import ARM as ARM_GROUP

ARM = tuple(joint.name for joint in ARM_GROUP.joints)
ELBOW_AND_INDEX = ("elbow_joint", "index_joint_1")
NOMINAL = JointDynamics.of()
ELBOW = NOMINAL.select(["elbow_joint"])


def test_nominal_dynamics_are_the_simulators():
    arm = NOMINAL.select(ARM)
    np.testing.assert_array_equal(arm.stiffness, [joint.stiffness for joint in ARM_GROUP.joints])
    np.testing.assert_array_equal(arm.armature, [joint.armature for joint in ARM_GROUP.joints])
    assert not arm.latency.any()
    assert not arm.has_filter.any()
    assert len(NOMINAL.joints) == 19


def test_dynamics_are_compared_by_value():
    same = ELBOW.with_values()
    assert same == ELBOW
    assert hash(same) == hash(ELBOW)
    assert all(ELBOW.with_values(**{name: 0.123}) != ELBOW for name in PARAMETERS)
    assert NOMINAL.select(["wrist_1_joint"]) != ELBOW


def test_joints_over_others():
    arm, both = NOMINAL.select(ARM), NOMINAL.select(ELBOW_AND_INDEX).with_values(latency=0.1)
    full = both.over(arm)
    assert full.joints == (*ARM, "index_joint_1")
    assert full.latency.tolist() == [0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.1]
    assert full.stiffness[-1] == 3.0
    assert full.select(ELBOW_AND_INDEX) == both
    late = arm.over(both)
    assert dict(zip(late.joints, late.latency, strict=True)) == {
        **dict.fromkeys(ARM, 0.0),
        "index_joint_1": 0.1,
    }
    assert arm.over(NOMINAL) == NOMINAL


def test_command_lag_by_hand():
    """Half a step, another one for the filter, and the latency."""
    both = NOMINAL.select(ELBOW_AND_INDEX).with_values(latency=0.003, filter_gain=[300.0, np.inf])
    np.testing.assert_allclose(both.command_lag(0.01), (0.013, 0.008))
