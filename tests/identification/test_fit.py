"""Known truth: simulated joints with noise, latency and stalled clocks give their dynamics back; so does
`benchmarks/independent_robot.py`, a robot that shares nothing with our simulation."""

from dataclasses import replace

import numpy as np
import pytest
from identify_independent_truth import found_in
from independent_robot import Faults
from recorded import NOISE, record

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification.fit import FILTER_PARAMETERS, FitCfg, fit_dynamics
from pixel2catch.identification.identify import LAG, estimates
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.rehearsal import unlike_nominal
from pixel2catch.identification.simulation import RecordedMotion, behind_play
from pixel2catch.robots.joint_dynamics import JointDynamics

DT = 1.0 / 240.0
JOINTS = ("elbow_joint", "index_joint_1")


def tracking_error(recording: Recording, dynamics: JointDynamics) -> np.ndarray:
    """Root mean square of simulated minus measured positions, per joint [rad]."""
    motion = RecordedMotion([recording], DT)
    (simulated,) = motion.simulate([dynamics])
    return np.sqrt(np.mean((simulated - motion.measured) ** 2, axis=0))


def test_servo_is_recovered():
    """The truth moves at a quarter of the fit's time step. Errors are below 60 % of the goals."""
    rng = np.random.default_rng(0)
    nominal = JointDynamics.of().select(JOINTS)
    truth = unlike_nominal(rng, nominal, latency=0.012)
    fitted, held_out = (record(rng, truth, seconds, DT / 4) for seconds in (6.0, 2.0))
    fit = fit_dynamics([fitted], nominal, FitCfg(physics_dt=DT))
    found = fit.dynamics
    np.testing.assert_allclose(found.damping / found.stiffness, truth.damping / truth.stiffness, rtol=0.012)
    np.testing.assert_allclose(found.armature[1], truth.armature[1], rtol=0.03)
    np.testing.assert_allclose(found.latency, truth.latency, atol=6e-4)
    assert (tracking_error(held_out, nominal) > 10 * NOISE).all()
    best = tracking_error(held_out, truth)  # beyond noise: a joint sticks where noise says it began
    assert (tracking_error(held_out, found) < 1.2 * best).all()
    known = estimates(fit)
    for name in ("stiffness", "damping", "frictionloss", "armature"):
        error = np.abs(np.log(getattr(found, name) / getattr(truth, name)))
        assert (error < 2.0 * known[name].half_width + 0.02).all(), name
    assert (known[LAG].half_width < (0.02, 0.04)).all()  # dry friction is a larger share of the finger


def test_command_filter_is_recovered():
    rng = np.random.default_rng(1)
    servo = JointDynamics.of().select(JOINTS)
    start = servo.with_values(damping=servo.damping / 10, filter_gain=200.0, filter_lookahead=0.2)
    truth = start.with_values(filter_gain=300.0, filter_lookahead=0.1, latency=0.004)
    fitted, held_out = record(rng, truth, 2.0, DT), record(rng, truth, 1.5, DT)
    found = fit_dynamics([fitted], start, FitCfg(free=FILTER_PARAMETERS, physics_dt=DT)).dynamics
    np.testing.assert_allclose(found.filter_gain, 300.0, rtol=0.02)
    np.testing.assert_allclose(found.filter_lookahead, 0.1, rtol=0.02)
    np.testing.assert_allclose(found.latency, 0.004, atol=0.001)
    best = tracking_error(held_out, truth)  # the finger feels what is left of the elbow's error, too
    assert (tracking_error(held_out, found) < 1.4 * best).all()


def test_clocks_that_drift_play_and_zeros_are_found():
    """The clock of the measurements is 0.1 % fast, the finger's encoder 4 mrad loose and 2 mrad off."""
    rng = np.random.default_rng(4)
    nominal = JointDynamics.of().select(JOINTS)
    recording = record(rng, nominal.with_values(latency=0.012), 4.0, DT)
    read = behind_play(recording.q, np.array((0.0, 4e-3)))
    late = replace(recording, t_meas=1.001 * recording.t_meas, q=read + np.array((0.0, 2e-3)))
    fit = fit_dynamics([late], nominal, FitCfg(free=("damping", "frictionloss", "latency"), physics_dt=DT))
    np.testing.assert_allclose(fit.encoders.drift, 1e-3, atol=1e-4)
    np.testing.assert_allclose(fit.encoders.play, (0.0, 4e-3), atol=4e-4)
    np.testing.assert_allclose(fit.encoders.zero, [(0.0, 2e-3)], atol=2e-4)
    np.testing.assert_allclose(fit.dynamics.latency, 0.012, atol=2e-4)
    assert (fit.encoder_deviations.play < (5e-4, 1.2e-3)).all()


def test_a_lost_command_hardly_moves_a_fit():
    """A jump that arrives 40 ms late counts as one odd event, not as a lag of the joint."""
    rng = np.random.default_rng(5)
    nominal = JointDynamics.of().select(JOINTS[1:])
    recording = record(rng, nominal, 4.0, DT)
    jump = int(np.argmax(np.abs(np.diff(recording.q_cmd[:, 0])))) + 1
    sent = recording.t_cmd.copy()
    sent[jump] -= min(0.04, 0.9 * (sent[jump] - sent[jump - 1]))
    late = replace(recording, t_cmd=sent)
    start = nominal.with_values(damping=1.2 * nominal.damping)
    found = fit_dynamics([late], start, FitCfg(free=("damping", "latency"), physics_dt=DT)).dynamics
    np.testing.assert_allclose(found.damping, nominal.damping, rtol=0.01)


def test_impossible_fits_are_refused():
    rng = np.random.default_rng(2)
    nominal = JointDynamics.of().select(JOINTS)
    recording = record(rng, nominal, 1.0, DT)
    with pytest.raises(InvalidValueError, match="start with filter_gain=300"):
        fit_dynamics([recording], nominal, FitCfg(free=FILTER_PARAMETERS))
    with pytest.raises(InvalidValueError, match="select the same joints"):
        fit_dynamics([recording], JointDynamics.of().select(["elbow_joint"]), FitCfg())
    with pytest.raises(UnknownNameError, match="Did you mean 'armature'"):
        FitCfg(free=("armatures",))


@pytest.mark.slow
def test_friction_and_clocks_of_a_robot_that_is_not_ours_are_found():
    rows = found_in((0, "index_joint_1"), 20.0, Faults(lost=0.02))["parameters"]
    for name, goal in (("frictionloss", 0.3), ("latency", 1e-3), (LAG, 0.02), ("drift 1", 6e-5)):
        assert abs(rows[name]["error"]) < goal, name
    assert all(rows[name]["holds"] for name in ("stiffness", "damping", "frictionloss", "armature"))
