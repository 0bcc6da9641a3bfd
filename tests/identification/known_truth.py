"""Recordings of simulated joints whose dynamics are known."""

import dataclasses

import numpy as np

from pixel2catch.identification.excitation import RATE, Envelope, multisine, steps
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import SETTLING, RecordedMotion
from pixel2catch.robots.joint_dynamics import JointDynamics

NOISE = 2e-4


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
    return dataclasses.replace(blank, q=q + NOISE * rng.standard_normal(q.shape))


def tracking_error(recordings: list[Recording], dynamics: JointDynamics, physics_dt: float) -> np.ndarray:
    """Root mean square of simulated minus measured positions, per joint [rad]."""
    motion = RecordedMotion(recordings, physics_dt)
    (simulated,) = motion.simulate([dynamics])
    return np.sqrt(np.mean((simulated - motion.measured) ** 2, axis=0))
