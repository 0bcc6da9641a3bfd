"""The dynamics file, the delay and the filter of the command path."""

import dataclasses
import json

import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification.commands import mean_commands
from pixel2catch.robot.constants import ARM_JOINTS
from pixel2catch.robot.joint_dynamics import (
    PARAMETERS,
    SERVOJ_GAIN,
    SERVOJ_LOOKAHEAD,
    JointDynamics,
    filter_transition,
)

ELBOW_AND_INDEX = ("elbow_joint", "index_joint_1")


def test_nominal_dynamics_are_the_simulators():
    arm = JointDynamics.nominal([joint.name for joint in ARM_JOINTS])
    np.testing.assert_array_equal(arm.stiffness, [joint.stiffness for joint in ARM_JOINTS])
    np.testing.assert_array_equal(arm.armature, [joint.armature for joint in ARM_JOINTS])
    assert not arm.latency.any()
    assert not arm.has_filter.any()
    assert len(JointDynamics.nominal().joints) == 19


def test_file_keeps_every_value(tmp_path):
    dynamics = JointDynamics.nominal(ELBOW_AND_INDEX).with_values(
        latency=0.0123456789, filter_gain=[SERVOJ_GAIN, np.inf], filter_lookahead=[SERVOJ_LOOKAHEAD, 0.0]
    )
    dynamics.save(tmp_path / "dynamics.json")
    loaded = JointDynamics.load(tmp_path / "dynamics.json")
    assert loaded.joints == ELBOW_AND_INDEX
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(dynamics, name))
    assert json.loads((tmp_path / "dynamics.json").read_text())["filter_gain"] == [300.0, None]


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("format_version", 9, "format_version is 9"),
        ("joints", ["elbow_joint", "index_joint_9"], "Did you mean"),
        ("joints", ["index_joint_1", "elbow_joint"], "in the order"),
        ("stiffness", [1.0, -2.0], "stiffness of index_joint_1 is -2; it must be more than 0"),
        ("latency", [float("nan"), 0.0], "latency of elbow_joint is nan"),
        ("damping", [1.0], "damping has 1 entries; it needs 2"),
        ("armature", "heavy", "Identify again, or correct that entry"),
        ("weight", [1.0, 1.0], "weight"),
    ],
)
def test_bad_file_names_its_fault(tmp_path, entry, value, message):
    path = tmp_path / "dynamics.json"
    JointDynamics.nominal(ELBOW_AND_INDEX).save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {entry: value}))
    with pytest.raises(InvalidValueError, match=message) as error:
        JointDynamics.load(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("content", ["", "{", "[]", "{}"])
def test_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "dynamics.json"
    path.write_text(content)
    with pytest.raises(InvalidValueError, match="cannot read the dynamics file"):
        JointDynamics.load(path)
    with pytest.raises(InvalidValueError, match="No such file"):
        JointDynamics.load(tmp_path / "missing.json")


def test_values_out_of_range_are_refused():
    elbow = JointDynamics.nominal(["elbow_joint"])
    with pytest.raises(InvalidValueError, match="filter_gain"):
        elbow.with_values(filter_gain=0.0)
    with pytest.raises(UnknownNameError, match="elbow"):
        dataclasses.replace(elbow, joints=("elbow",))


def test_delayed_command_counts_by_its_share_of_a_step():
    """A command 0 → 1 at 0.1 s arrives at 0.112 s: it holds for 8 of the 10 ms from 0.11 s."""
    edges = np.array((0.09, 0.10, 0.11, 0.12, 0.13))
    t_cmd, q_cmd = np.array((0.0, 0.1)), np.array(((0.0, 5.0), (1.0, 5.0)))
    mean = mean_commands(t_cmd, q_cmd, edges, np.array((0.012, 0.3)))
    np.testing.assert_allclose(mean[:, 0], (0.0, 0.0, 0.8, 1.0), atol=1e-9)
    np.testing.assert_allclose(mean[:, 1], 5.0)


def test_filter_lags_a_ramp_by_its_lookahead():
    """At constant speed q̈ = 0, so that u − q = lookahead q̇."""
    dt, speed = 0.002, 0.7
    elbow = JointDynamics.nominal(["elbow_joint"]).with_values(filter_gain=300.0, filter_lookahead=0.1)
    (step,) = filter_transition(elbow, dt)
    state = np.zeros(2)
    for k in range(3000):
        state = step @ (*state, speed * (k + 0.5) * dt)
    assert speed * 3000 * dt - state[0] == pytest.approx(0.1 * speed, abs=1e-6)
    assert state[1] == pytest.approx(speed, rel=1e-3)


def test_filter_step_is_exact():
    """One step of 20 ms is ten thousand of 2 µs."""
    elbow = JointDynamics.nominal(["elbow_joint"]).with_values(filter_gain=300.0, filter_lookahead=0.1)
    (step,) = filter_transition(elbow, 0.02)
    position, speed = 0.1, -0.4
    for _ in range(10_000):
        speed += 2e-6 * 300.0 * (1.0 - position - 0.1 * speed)
        position += 2e-6 * speed
    np.testing.assert_allclose(step @ (0.1, -0.4, 1.0), (position, speed), rtol=1e-4)


def test_no_filter_passes_the_command():
    (step,) = filter_transition(JointDynamics.nominal(["elbow_joint"]), 0.002)
    np.testing.assert_array_equal(step @ (0.3, 2.0, 1.25), (1.25, 0.0))
