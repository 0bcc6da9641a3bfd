"""Hand-made recordings: joints that follow sines with a known lag."""

import numpy as np

from pixel2catch.identification.recording import Recording, joints_of, specs_of
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

JOINT_SPECS = specs_of(UR5E_ALLEGRO)
ROBOTS = {name: joints_of(UR5E_ALLEGRO, name) for name in ("ur5e", "allegro", "ur5e_allegro")}
ARM = ROBOTS["ur5e"]
LAG = 0.06
FREQUENCIES = 1.1 + 0.13 * np.arange(6)
AMPLITUDE = 0.25


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
