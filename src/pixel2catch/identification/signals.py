"""Speed, acceleration, elapsed time and lag from recorded positions."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import correlate, correlation_lags, savgol_filter

from pixel2catch.identification.recording import Recording

SMOOTHING = 0.1
"""Length of the window in which a cubic is fitted for speed and acceleration [s].

Source: ours; 0.2 mrad of noise at 500 Hz become 0.07 rad/s², and motion up to about 5 Hz passes.
"""

NEIGHBOURS = 7
"""Steps whose median speed stands for that of the middle one, where none was recorded. Source: ours."""

REFINEMENTS = 10
"""Steps of Gauss and Newton for the lag. Source: ours; three are enough for sines."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Smoothed speed [rad/s] and acceleration [rad/s²], each of shape (samples, joints)."""

    speed: np.ndarray
    acceleration: np.ndarray


def time_step(time: np.ndarray) -> float:
    """Median of the steps that are not zero [s]; 0 if there are none."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def held(recording: Recording, time: np.ndarray) -> np.ndarray:
    """The command at some times [s] of its own clock: each holds until the next, the first also before it."""
    index = np.searchsorted(recording.t_cmd, time, side="right") - 1
    return recording.q_cmd[np.maximum(index, 0)]


def smoothed(time: np.ndarray, positions: np.ndarray) -> Motion:
    """Speed and acceleration of noisy positions, by a cubic around each sample of an even grid."""
    dt = time_step(time)
    even = _resampled(np.arange(time[0], time[-1], dt), time, positions)
    window = min(max(5, 2 * round(SMOOTHING / dt / 2) + 1), len(even) - 1 + len(even) % 2)
    speed, acceleration = (
        np.asarray(savgol_filter(even, window, polyorder=3, deriv=order, delta=dt, axis=0))
        for order in (1, 2)
    )
    return Motion(speed=speed, acceleration=acceleration)


def excess_time(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """How much more time the joints' motion took than the clock says, step by step.

    In a step Δt at speed q̇ the joints move by Δq = q̇·Δt. The excess is e = (Δq - q̇·Δt)·q̇ / |q̇|² [s].

    Returns:
        The excess [s] and the motion |q̇|·e that shows it [rad], each of shape (samples - 1,).
    """
    steps = np.diff(recording.t_meas)[:, None]
    moved = np.diff(recording.q, axis=0)
    speed = _step_speed(recording, moved, steps)
    norm = np.maximum(np.linalg.norm(speed, axis=1), 1e-9)
    surplus = ((moved - speed * steps) * speed).sum(1) / norm
    return surplus / norm, surplus


def progress(recording: Recording) -> float:
    """Median of Δq·q̇ / (q̇²Δt) over the faster half of the steps.

    It is 1 where the recorded speeds are those of the positions.
    """
    steps = np.diff(recording.t_meas)
    norm = np.linalg.norm(_step_speed(recording, np.diff(recording.q, axis=0), steps[:, None]), axis=1)
    is_moving = norm > np.quantile(norm, 0.5)
    excess, _ = excess_time(recording)
    return float(np.median(1 + (excess / steps)[is_moving])) if is_moving.any() else 1.0


def command_lag(recording: Recording) -> float | None:
    """By how much the measured motion follows the commanded one [s]; None if nothing moved or was commanded.

    The peak of the cross-correlation of the speeds, all joints together, tells it roughly, whenever the
    clocks were started; then the lag τ is the one for which q(t) - q_cmd(t - τ) varies least.
    """
    dt = time_step(recording.t_meas)
    grid_cmd = np.arange(recording.t_cmd[0], recording.t_cmd[-1] + dt, dt)
    grid_meas = np.arange(recording.t_meas[0], recording.t_meas[-1], dt)
    commanded = np.diff(held(recording, grid_cmd), axis=0)
    measured = np.diff(_resampled(grid_meas, recording.t_meas, recording.q), axis=0)
    pairs = zip(measured.T, commanded.T, strict=True)
    correlation = np.sum([correlate(meas, cmd, method="fft") for meas, cmd in pairs], axis=0)
    peak = int(np.argmax(correlation))
    if correlation[peak] <= 0:
        return None
    shift = dt * correlation_lags(len(measured), len(commanded))[peak]
    return _refined_lag(recording, grid_meas, float(grid_meas[0] - grid_cmd[0] + shift))


def _refined_lag(recording: Recording, grid: np.ndarray, lag: float) -> float:
    """Move a rough lag to where the tracking error, but for an offset of each joint, is least."""
    position = _resampled(grid, recording.t_meas, recording.q)
    speed = smoothed(recording.t_meas, recording.q).speed
    for _ in range(REFINEMENTS):
        sent = grid - lag
        is_inside = (sent >= recording.t_cmd[0]) & (sent <= recording.t_cmd[-1])
        if not is_inside.any():
            break
        error = position[is_inside] - held(recording, sent[is_inside])
        slope = speed[is_inside] - speed[is_inside].mean(0)
        lag -= float((error * slope).sum() / max((slope**2).sum(), 1e-12))
    return lag


def _step_speed(recording: Recording, moved: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Speed in each step [rad/s]: the mean of those recorded at its ends, or the median of its neighbours."""
    if recording.qd is not None:
        return (recording.qd[1:] + recording.qd[:-1]) / 2
    return median_filter(moved / np.maximum(steps, 1e-9), size=(NEIGHBOURS, 1), mode="nearest")


def _resampled(grid: np.ndarray, time: np.ndarray, positions: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(grid, time, column) for column in positions.T], axis=-1)
