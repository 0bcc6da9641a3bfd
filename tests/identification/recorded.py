"""Recordings: joints that follow sines with a known lag, and simulated joints of known dynamics."""

from dataclasses import replace

import numpy as np

from pixel2catch.identification.excitation import RATE, Envelope, multisine, steps
from pixel2catch.identification.recording import Recording, joints_of, specs_of
from pixel2catch.identification.simulation import SETTLING, RecordedMotion
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

JOINT_SPECS = specs_of(UR5E_ALLEGRO)
ROBOTS = {name: joints_of(UR5E_ALLEGRO, name) for name in ("ur5e", "allegro", "ur5e_allegro")}
ARM = ROBOTS["ur5e"]
LAG = 0.06
FREQUENCIES = 1.1 + 0.13 * np.arange(6)
AMPLITUDE = 0.25
NOISE = 2e-4


def position(time: np.ndarray, joints: tuple[str, ...] = ARM) -> np.ndarray:
    """Sines of 0.25 rad and 1.1 to 1.75 Hz around the start pose."""
    home = np.array([JOINT_SPECS[joint].home for joint in joints])
    return home + AMPLITUDE * np.sin(2 * np.pi * FREQUENCIES[np.arange(len(joints)) % 6] * time[:, None])


def speed(time: np.ndarray, joints: tuple[str, ...] = ARM) -> np.ndarray:
    """Derivative of `position`."""
    omega = 2 * np.pi * FREQUENCIES[np.arange(len(joints)) % 6]
    return AMPLITUDE * omega * np.cos(omega * time[:, None])


def clean(joints: tuple[str, ...] = ARM, noise: float = 2e-4) -> Recording:
    """Eight seconds at 500 Hz with noise [rad], commands at 125 Hz, measured 60 ms behind the command."""
    t_cmd = np.arange(0.0, 8.0, 0.008)
    t_meas = np.arange(0.001, 8.0, 0.002)
    q = position(t_meas - LAG, joints)
    q = q + noise * np.random.default_rng(0).standard_normal(q.shape)
    return Recording(joints=joints, t_cmd=t_cmd, q_cmd=position(t_cmd, joints), t_meas=t_meas, q=q)


def short() -> Recording:
    """Five commands and eleven measurements of all signals, for files."""
    t_cmd, t_meas = np.arange(0.0, 0.5, 0.1), np.arange(0.02, 0.5, 0.04)[:11]
    q, qd = position(t_meas), speed(t_meas)
    return Recording(joints=ARM, t_cmd=t_cmd, q_cmd=position(t_cmd), t_meas=t_meas, q=q, qd=qd)


def assert_same(got: Recording, expected: Recording, tolerance: float = 0.0) -> None:
    """Both have the same joints, the same optional signals and the same numbers."""
    assert got.joints == expected.joints
    for name in ("t_cmd", "q_cmd", "t_meas", "q", "qd"):
        one, other = getattr(got, name), getattr(expected, name)
        assert (one is None) == (other is None), name
        if one is not None:
            assert one.dtype == np.float64
            np.testing.assert_allclose(one, other, rtol=0, atol=tolerance, err_msg=name)


def stalled_clock(rng: np.random.Generator, seconds: float, period: float) -> np.ndarray:
    """Times of a loop of which 5 % of the turns take 40 ms."""
    turns = np.where(rng.random(int(seconds / period)) < 0.05, 0.04, period)
    times = np.cumsum(turns) - turns[0]
    return times[times < seconds]


def excitation(
    rng: np.random.Generator, joints: tuple[str, ...], seconds: float
) -> tuple[np.ndarray, np.ndarray]:
    """Half sines and half steps of `excite` at full speed, sent at 125 Hz: times and positions [rad]."""
    t_cmd = stalled_clock(rng, seconds, 1 / RATE)
    envelope = Envelope.of(joints, 1.0, {})
    num = int(seconds * RATE) // 2 + 1
    targets = envelope.center + np.concatenate([signal(rng, envelope, num) for signal in (multisine, steps)])
    return t_cmd, targets[(t_cmd * RATE).astype(int)]


def record(rng: np.random.Generator, truth: JointDynamics, seconds: float, physics_dt: float) -> Recording:
    """Measurements with noise at 125 Hz by a clock that stalls; the robot rests at first."""
    t_cmd, q_cmd = excitation(rng, truth.joints, seconds - SETTLING)
    t_meas = stalled_clock(rng, seconds, 0.008)
    q = np.repeat(q_cmd[:1], len(t_meas), axis=0)
    blank = Recording(joints=truth.joints, t_cmd=SETTLING + t_cmd, q_cmd=q_cmd, t_meas=t_meas, q=q)
    (path,) = RecordedMotion([blank], physics_dt).simulate([truth])
    q[-len(path) :] = path
    return replace(blank, q=q + NOISE * rng.standard_normal(q.shape))


def tracking_error(recordings: list[Recording], dynamics: JointDynamics, physics_dt: float) -> np.ndarray:
    """Root mean square of simulated minus measured positions, per joint [rad]."""
    motion = RecordedMotion(recordings, physics_dt)
    (simulated,) = motion.simulate([dynamics])
    return np.sqrt(np.mean((simulated - motion.measured) ** 2, axis=0))
