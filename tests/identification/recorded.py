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


def clean(joints: tuple[str, ...] = ARM, noise: float = 2e-4) -> Recording:
    """Eight seconds at 500 Hz with noise [rad], commands at 125 Hz, measured 60 ms behind the command."""
    t_cmd = np.arange(0.0, 8.0, 0.008)
    t_meas = np.arange(0.001, 8.0, 0.002)
    q = position(t_meas - LAG, joints)
    q = q + noise * np.random.default_rng(0).standard_normal(q.shape)
    return Recording(joints=joints, t_cmd=t_cmd, q_cmd=position(t_cmd, joints), t_meas=t_meas, q=q)


def short() -> Recording:
    """Five commands and eleven measurements, for files."""
    t_cmd, t_meas = np.arange(0.0, 0.5, 0.1), np.arange(0.02, 0.5, 0.04)[:11]
    return Recording(joints=ARM, t_cmd=t_cmd, q_cmd=position(t_cmd), t_meas=t_meas, q=position(t_meas))


def assert_same(got: Recording, expected: Recording, tolerance: float = 0.0) -> None:
    """Both have the same joints and the same numbers."""
    assert got.joints == expected.joints
    for name in ("t_cmd", "q_cmd", "t_meas", "q"):
        one, other = getattr(got, name), getattr(expected, name)
        assert one.dtype == np.float64
        np.testing.assert_allclose(one, other, rtol=0, atol=tolerance, err_msg=name)


def stalled_clock(rng: np.random.Generator, seconds: float, period: float) -> np.ndarray:
    """Times of a loop of which 5 % of the turns take 40 ms."""
    turns = np.where(rng.random(int(seconds / period)) < 0.05, 0.04, period)
    times = np.cumsum(turns) - turns[0]
    return times[times < seconds]


def record(rng: np.random.Generator, truth: JointDynamics, seconds: float, physics_dt: float) -> Recording:
    """Half sines and half steps of `excite`, sent and measured at 125 Hz by clocks that stall."""
    t_cmd = stalled_clock(rng, seconds - SETTLING, 1 / RATE)
    envelope = Envelope.of(truth.joints, 1.0, {}, UR5E_ALLEGRO)
    num = int((seconds - SETTLING) * RATE) // 2 + 1
    targets = envelope.center + np.concatenate([signal(rng, envelope, num) for signal in (multisine, steps)])
    q_cmd, t_meas = targets[(t_cmd * RATE).astype(int)], stalled_clock(rng, seconds, 0.008)
    return simulated(rng, truth, physics_dt, SETTLING + t_cmd, q_cmd, t_meas)


def simulated(
    rng: np.random.Generator,
    truth: JointDynamics,
    physics_dt: float,
    t_cmd: np.ndarray,
    q_cmd: np.ndarray,
    t_meas: np.ndarray,
) -> Recording:
    """A recording of joints of known dynamics that start at rest, measured with noise."""
    q = np.repeat(q_cmd[:1], len(t_meas), axis=0)
    blank = Recording(joints=truth.joints, t_cmd=t_cmd, q_cmd=q_cmd, t_meas=t_meas, q=q)
    (path,) = RecordedMotion([blank], physics_dt).simulate([truth])
    q[-len(path) :] = path
    return replace(blank, q=q + NOISE * rng.standard_normal(q.shape))
