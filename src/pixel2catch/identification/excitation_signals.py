"""The kinds of motion that tell joint dynamics, as offsets from the middle of the excitation.

Each is zero at both ends and keeps to an `Envelope`. Smooth ones keep to speed and acceleration, targets that
ramp to the speed, steps to the largest jump.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from pixel2catch.identification.excitation_limits import Envelope

RATE = 125.0
"""Targets in a second [Hz].

Source: ours; every fourth cycle of a UR e-series controller (500 Hz), and four times a policy's 30 Hz.
"""

NUM_TONES = 9
BAND = (0.25, 5.0)
"""Number and lowest and highest frequency of the sines [Hz].

Source: ours. Damping over stiffness of the joints corresponds to 1.2 Hz (arm) and 4.8 Hz (hand); the drives'
inertia shows above.
"""

FADE = 0.4
"""Time in which sines fade in and out [s] (ours)."""

DWELL = (0.25, 0.65)
"""Shortest and longest time between a joint's steps [s]. Source: ours, 2 to 5 time constants of the arm."""

POLICY_PERIOD = 0.05
"""Time between two targets like those of a policy [s].

Source: ours, 20 Hz: a little slower than our policies, so that the servos come nearer to the targets.
"""

SLOW_SPEED = 0.15
"""Top speed of slow reversals [rad/s]. Source: ours; dry friction turns around within 0.1 rad/s."""

APPROACH = 1.5
"""Shortest time from the start pose to the middle of the excitation [s] (ours)."""

NUM_TURNS = 6
"""Groups of joints that move in turns: each joint of the arm alone, and one joint of each finger."""

Offsets = Float64[np.ndarray, "num_times num_joints"]

Signal = Callable[[Generator, Envelope, int], Offsets]


def multisine(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Sines of all joints at once, each joint with its own frequencies; all tones have about one speed."""
    time = np.arange(num_times)[:, None, None] / RATE
    shape = (NUM_TONES, len(envelope.joints))
    frequency = np.geomspace(*BAND, NUM_TONES)[:, None] * rng.uniform(0.9, 1.1, shape)
    phase = rng.uniform(0.0, 2 * np.pi, shape)
    tones = np.sin(2 * np.pi * frequency * time + phase) / frequency
    return within(envelope, faded(tones.sum(axis=1)))


def slow_reversals(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Two or three slow turns there and back, for dry friction."""
    duration = num_times / RATE
    frequency = rng.integers(2, 4, len(envelope.joints)) / duration
    amplitude = rng.choice((-1.0, 1.0), len(frequency)) * SLOW_SPEED / (2 * np.pi * frequency)
    slow = faded(amplitude * np.sin(2 * np.pi * frequency * np.arange(num_times)[:, None] / RATE))
    return slow * np.minimum(1.0, _room(envelope, slow))


def steps(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Jumps of every joint at its own times; they load the drives' inertia up to the servos' torque limit."""
    bounds = np.minimum(envelope.swing, envelope.step)
    sizes = np.minimum(2 * envelope.swing, envelope.step)
    columns = [_steps(rng, bound, size, num_times) for bound, size in zip(bounds, sizes, strict=True)]
    return np.stack(columns, axis=-1)


def _steps(rng: Generator, bound: float, size: float, num_times: int) -> Float64[np.ndarray, " num_times"]:
    """Levels of one joint within ± bound, each jump at most `size` and towards the other side."""
    shortest = round(RATE * DWELL[0])
    dwell = RATE * rng.uniform(*DWELL, num_times // shortest + 1)
    latest = max(1, num_times - 2 * shortest)
    starts = (rng.uniform(1.0, min(shortest, latest)) + np.cumsum(dwell) - dwell[0]).astype(int)
    column, level = np.zeros(num_times), 0.0
    for start in starts[starts <= latest]:
        side = -np.sign(level) or rng.choice((-1.0, 1.0))
        level = float(np.clip(level + side * size * rng.uniform(0.5, 1.0), -bound, bound))
        column[start : num_times - shortest] = level
    return column


def policy_targets(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """A random walk at 20 Hz with a ramp from target to target, as our environment sends a policy's."""
    change = envelope.speed * POLICY_PERIOD
    times = np.arange(num_times) / RATE
    num_changes = int(times[-1] / POLICY_PERIOD)
    targets = np.zeros((num_changes + 1, len(change)))
    for k in range(1, num_changes):
        walked = targets[k - 1] + change * rng.uniform(-1.0, 1.0, len(change))
        bound = np.minimum(envelope.swing, (num_changes - k) * change)
        targets[k] = np.clip(walked, -bound, bound)
    knots = POLICY_PERIOD * np.arange(num_changes + 1)
    return np.stack([np.interp(times, knots, column) for column in targets.T], axis=-1)


def turns(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Steps of one group of joints after the other, so that no joint hides behind the pull of others."""
    turn = np.arange(len(envelope.joints)) % NUM_TURNS
    edges = np.linspace(0, num_times, NUM_TURNS + 1).astype(int)
    parts = [steps(rng, envelope.only(turn == k), int(num)) for k, num in enumerate(np.diff(edges))]
    return np.concatenate(parts)


def approach(envelope: Envelope) -> Offsets:
    """From the start pose to the middle: a quintic polynomial without jerk at its ends.

    Its top speed is 15/8 of the mean one, its top acceleration 10/√3 of distance over time squared.
    """
    way = envelope.home - envelope.center
    distance = np.abs(way)
    duration = max(
        APPROACH,
        float(np.max(15 / 8 * distance / envelope.speed)),
        float(np.max(np.sqrt(10 / np.sqrt(3) * distance / envelope.acceleration))),
    )
    share = np.linspace(0.0, 1.0, int(np.ceil(duration * RATE)) + 1)[:, None]
    return way * (1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2))


def faded(offsets: Offsets) -> Offsets:
    """Let a signal begin and end at zero, smoothly."""
    time = np.minimum(np.arange(len(offsets)), np.arange(len(offsets))[::-1]) / RATE
    return np.sin(np.pi / 2 * np.minimum(1.0, time / FADE))[:, None] ** 2 * offsets


def within(envelope: Envelope, offsets: Offsets) -> Offsets:
    """Scale each joint's signal so that it just keeps to swing, speed and acceleration."""
    return offsets * _room(envelope, offsets)


def _room(envelope: Envelope, offsets: Offsets) -> Float64[np.ndarray, " num_joints"]:
    """By how much each joint's signal could be larger."""
    limits = (envelope.swing, envelope.speed, envelope.acceleration)
    peaks = [np.abs(np.diff(offsets, n, axis=0)).max(axis=0) * RATE**n for n in range(3)]
    return np.min(
        [limit / np.maximum(peak, 1e-12) for limit, peak in zip(limits, peaks, strict=True)], axis=0
    )
