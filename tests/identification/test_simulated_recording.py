"""Recordings of a simulated robot: noise, stalls, two clocks, latency."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pixel2catch.errors import InvalidValueError
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.rehearsal import (
    STALLED_TURN,
    RecorderCfg,
    rehearse,
    simulated_recordings,
    turns_of_a_loop,
    unlike_nominal,
)
from pixel2catch.identification.robot import ROBOTS
from pixel2catch.identification.simulation import FIT_DT
from pixel2catch.identification.trajectory import Trajectory
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robot.joint_dynamics import JointDynamics

JOINTS = ("elbow_joint", "index_joint_2")
HOME = (2 / 3 * np.pi, 0.0)
PERFECT = RecorderCfg(noise=0.0, stall=0.0, read_period=FIT_DT)


def bump(size: float) -> Trajectory:
    """A smooth motion there and back."""
    times = np.arange(401) / 125.0
    positions = np.tile(HOME, (401, 1))
    positions[130:260] += size * np.sin(np.linspace(0.0, np.pi, 130))[:, None] ** 2
    return Trajectory(joints=JOINTS, times=times, positions=positions)


def record(cfg: RecorderCfg, *sizes: float, seed: int = 0, **truth: float) -> list[Recording]:
    dynamics = JointDynamics.nominal(JOINTS).with_values(**truth)
    return simulated_recordings([bump(size) for size in sizes], dynamics, cfg, np.random.default_rng(seed))


def test_turns_of_a_loop_are_even_or_stalled():
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(turns_of_a_loop(rng, 0.05, 0.01, 0.0), [0.0, 0.01, 0.02, 0.03, 0.04])
    turns = turns_of_a_loop(rng, 400.0, 0.008, 0.05)
    lengths = np.diff(turns)
    is_stalled = np.isclose(lengths, STALLED_TURN)
    assert (is_stalled | np.isclose(lengths, 0.008)).all()
    assert is_stalled.mean() == pytest.approx(0.05, abs=0.005)
    assert 399.9 < turns[-1] < 400.0


def test_both_loops_stall_each_in_its_own_time():
    (recording,) = record(RecorderCfg(), 0.2)
    sent, read = (time[:-1][np.diff(time) > 0.03] for time in (recording.t_cmd, recording.t_meas))
    assert min(len(sent), len(read)) > 3
    assert not np.isin(np.round(sent, 2), np.round(read, 2)).all()
    np.testing.assert_array_equal(recording.q_cmd, bump(0.2).at(recording.t_cmd))


def test_noise_is_as_asked_for():
    noisy, clean = (record(RecorderCfg(noise=noise), 0.2)[0] for noise in (1e-3, 0.0))
    np.testing.assert_array_equal(noisy.t_meas, clean.t_meas)
    assert np.std(noisy.q - clean.q) == pytest.approx(1e-3, rel=0.1)


def test_each_recording_follows_its_own_trajectory_and_returns():
    small, large = record(PERFECT, 0.05, 0.2)
    for recording, size in ((small, 0.05), (large, 0.2)):
        np.testing.assert_allclose(recording.q[[0, -1]], [HOME, HOME], atol=3e-3)
        # the finger, whose servo takes 33 ms, nearly gets there; the arm, with 135 ms, does not
        elbow, finger = np.ptp(recording.q, axis=0) / size
        assert 0.6 < elbow < 0.95 < finger < 1.0


def test_latency_shifts_the_motion():
    shift = 8
    (prompt,), (late,) = record(PERFECT, 0.2), record(PERFECT, 0.2, latency=shift * FIT_DT)
    np.testing.assert_allclose(late.q[shift:], prompt.q[:-shift], atol=1e-9)


def test_an_offset_of_the_clocks_shifts_the_measured_times_alone():
    (ours,), (theirs,) = (
        record(dataclasses.replace(PERFECT, clock_offset=offset), 0.2) for offset in (0.0, 5.0)
    )
    np.testing.assert_allclose(theirs.t_meas, ours.t_meas + 5.0)
    np.testing.assert_array_equal(theirs.t_cmd, ours.t_cmd)
    np.testing.assert_array_equal(theirs.q, ours.q)


def test_a_rehearsal_writes_recordings_and_the_truth(tmp_path: Path):
    truth = unlike_nominal(np.random.default_rng(5), JOINTS)
    rehearse(tmp_path / "new", [bump(0.1), bump(0.2)], truth, RecorderCfg(), seed=0)
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["recording-1.npz", "recording-2.npz", "truth.json"]
    assert DynamicsFile.load(tmp_path / "new" / "truth.json").dynamics == truth
    ranges = [np.ptp(Recording.load(tmp_path / "new" / name).q[:, 1]) for name in names[:2]]
    np.testing.assert_allclose(ranges, [0.1, 0.2], rtol=0.1)


def test_truth_is_unlike_the_nominal_robot():
    joints = ROBOTS["ur5e_allegro"]
    truth, nominal = unlike_nominal(np.random.default_rng(0), joints), JointDynamics.nominal(joints)
    for name in ("stiffness", "damping", "frictionloss", "armature"):
        ratio = getattr(truth, name) / getattr(nominal, name)
        assert 0.7 <= ratio.min() < 0.9
        assert 1.1 < ratio.max() <= 1.4
    assert (truth.latency == 0.012).all()


def test_impossible_recorders_are_refused():
    for wrong in (
        {"noise": -1.0},
        {"noise": float("nan")},
        {"stall": 1.0},
        {"read_period": 0.0},
        {"physics_hz": 0.0},
    ):
        with pytest.raises(InvalidValueError, match=next(iter(wrong))):
            RecorderCfg(**wrong)
