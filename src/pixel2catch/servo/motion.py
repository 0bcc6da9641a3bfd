"""Motion of commands within limits: every tick moves towards a goal, and can always still stop in time.

A tick chooses a speed v, which moves a position by v dt. Braking from it takes the ticks v, v - a dt, and so
on, that are left above 0. A command is the mean of the newest n positions: it keeps their limits of position,
speed and acceleration, as every mean does, and its acceleration changes by (a - a of n ticks ago) / n in a
tick, which limits its jerk to 2 a / (n dt). All of it is exact in discrete time: rounding aside, no limit is
passed.

Each function is of one joint, whose limits are an entry of `MotionLimits.records`.
"""

from math import copysign

import numpy as np

from pixel2catch.servo.compilation import Record, compiled


@compiled
def clipped(value: float, lower: float, upper: float) -> float:
    """A value within bounds; no number if any of them is none."""
    return np.minimum(np.maximum(value, lower), upper)


@compiled
def fastest(distance: float, limits: Record) -> float:
    """Largest speed [rad/s] of a tick after which braking ends within a distance [rad], 0 or more.

    Braking from v = (n + f) a dt, n whole and 0 <= f < 1, takes ((n + 1) f + n (n + 1) / 2) a dt².
    """
    share = distance / limits.bend
    whole = np.floor(np.sqrt(2.0 * share + 0.25) - 0.5)
    return (share / (whole + 1.0) + 0.5 * whole) * limits.change


@compiled
def wished(position: float, goal: float, limits: Record) -> float:
    """Speed that leads to a goal [rad] without passing it, were there no other limit [rad/s]."""
    distance = goal - position
    return copysign(fastest(abs(distance), limits), distance)


@compiled
def towards(position: float, velocity: float, wish: float, limits: Record) -> float:
    """The speed of a tick that is nearest to what is wished and within all limits [rad, rad/s]."""
    below = np.minimum(fastest(np.maximum(position - limits.lower, 0.0), limits), limits.speed)
    above = np.minimum(fastest(np.maximum(limits.upper - position, 0.0), limits), limits.speed)
    slowest = np.maximum(velocity - limits.change, -below)
    return clipped(wish, slowest, np.minimum(velocity + limits.change, above))


@compiled
def braked(position: float, velocity: float, num_ticks: int, limits: Record) -> float:
    """Position after a number of ticks of braking [rad]."""
    speed = abs(velocity)
    whole = np.minimum(num_ticks, np.floor(speed / limits.change))
    covered = whole * (speed - limits.change * (0.5 * whole + 0.5))
    return position + copysign(limits.dt, velocity) * covered


@compiled
def braking(velocity: float, limits: Record) -> float:
    """Speed after a tick of braking [rad/s]."""
    return copysign(np.maximum(abs(velocity) - limits.change, 0.0), velocity)


@compiled
def averaged(recent: np.ndarray, position: float, limits: Record) -> float:
    """Put a position behind the newest ones, oldest first, and return the command that they make [rad]."""
    command, last = 0.0, len(recent) - 1
    for number in range(last + 1):
        recent[number] = recent[number + 1] if number < last else position
        if number > last - limits.window:
            command += recent[number] * limits.share
    return command


@compiled
def on_the_way(start: float, end: float, elapsed: float, duration: float) -> float:
    """Where an even motion is that takes some time, and has taken a part of it [rad]; then at its end."""
    return start + clipped(elapsed / duration, 0.0, 1.0) * (end - start)
