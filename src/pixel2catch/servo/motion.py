"""Motion of commands within limits: every tick moves towards a goal, and can always still stop in time.

A tick chooses a speed v, which moves a position by v dt. Braking from it takes the ticks v, v - a dt, and so
on, that are left above 0. A command is the mean of the newest n positions: it keeps their limits of position,
speed and acceleration, as every mean does, and its acceleration changes by (a - a of n ticks ago) / n in a
tick, which limits its jerk to 2 a / (n dt). All of it is exact in discrete time: rounding aside, no limit is
passed.
"""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from pixel2catch.scene.constants import CONTROL_DT

Rows = Float64[np.ndarray, "rows joints"]
Recent = Float64[np.ndarray, "ticks rows joints"]
Joints = Float64[np.ndarray, " joints"]
Times = Float64[np.ndarray, " rows"]
Flags = Bool[np.ndarray, " rows"]
Bits = Int64[np.ndarray, " rows"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionLimits:
    """What the motion of every joint's command keeps to."""

    lower: Joints  #: Lowest position [rad].
    upper: Joints  #: Highest position [rad].
    speed: Joints  #: Largest speed [rad/s].
    acceleration: Joints  #: Largest acceleration [rad/s²].
    jerk: Joints  #: Largest jerk [rad/s³].
    dt: float  #: Length of a tick [s].

    def only(self, joints: slice | Int64[np.ndarray, " some"]) -> "MotionLimits":
        """The limits of some joints."""
        names = [entry.name for entry in fields(self) if entry.name != "dt"]
        return MotionLimits(**{name: getattr(self, name)[joints] for name in names}, dt=self.dt)

    @cached_property
    def window(self) -> Int64[np.ndarray, " joints"]:
        """How many positions a command of each joint is the mean of."""
        ticks = 2.0 * self.acceleration / (self.jerk * self.dt)
        return np.maximum(np.ceil(ticks * (1.0 - 1e-12)), 1.0).astype(np.int64)

    @cached_property
    def weights(self) -> Float64[np.ndarray, "ticks 1 joints"]:
        """What each of the newest positions counts in a command, oldest first."""
        age = np.arange(self.window.max())[::-1, None]
        return ((age < self.window) / self.window)[:, None]

    @cached_property
    def change(self) -> Joints:
        """Largest change of the speed in a tick [rad/s]."""
        return self.acceleration * self.dt

    @cached_property
    def bend(self) -> Joints:
        """Largest change of the way of a tick from one to the next [rad]."""
        return self.change * self.dt

    @property
    def delay(self) -> Joints:
        """How much later than the positions the commands are [s]."""
        return (self.window - 1) / 2.0 * self.dt


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Where commands are on their way to, one row per robot."""

    position: Rows  #: Positions [rad].
    velocity: Rows  #: Speeds of the tick that led there [rad/s].

    def only(
        self, rows: Int64[np.ndarray, " some_rows"], joints: slice | Int64[np.ndarray, " some_joints"]
    ) -> "Motion":
        """The motion of some joints of some rows."""
        return Motion(position=self.position[rows][:, joints], velocity=self.velocity[rows][:, joints])

    def moved(self, velocity: Rows, dt: float) -> "Motion":
        """A tick with a speed [rad/s]."""
        return Motion(position=self.position + velocity * dt, velocity=velocity)


def fastest(
    distance: Float64[np.ndarray, "*rows joints"], limits: MotionLimits
) -> Float64[np.ndarray, "*rows joints"]:
    """Largest speed [rad/s] of a tick after which braking ends within a distance [rad], 0 or more.

    Braking from v = (n + f) a dt, n whole and 0 <= f < 1, takes ((n + 1) f + n (n + 1) / 2) a dt².
    """
    share = distance / limits.bend
    whole = np.floor(np.sqrt(2.0 * share + 0.25) - 0.5)
    return (share / (whole + 1.0) + 0.5 * whole) * limits.change


def wished(motion: Motion, goal: Rows, limits: MotionLimits) -> Rows:
    """Speeds that lead to a goal [rad] without passing it, were there no other limit [rad/s]."""
    distance = goal - motion.position
    return np.copysign(fastest(np.abs(distance), limits), distance)


def towards(motion: Motion, wish: Rows, limits: MotionLimits) -> Motion:
    """The tick whose speeds are nearest to what is wished [rad/s] and within all limits."""
    room = np.array((motion.position - limits.lower, limits.upper - motion.position))
    below, above = np.minimum(fastest(np.maximum(room, 0.0), limits), limits.speed)
    slowest = np.maximum(motion.velocity - limits.change, -below)
    quickest = np.minimum(motion.velocity + limits.change, above)
    return motion.moved(clipped(wish, slowest, quickest), limits.dt)


def braked(motion: Motion, limits: MotionLimits, num_ticks: Int64[np.ndarray, "ticks 1 1"]) -> Recent:
    """Positions after some numbers of ticks of braking [rad]."""
    speed = np.abs(motion.velocity)
    whole = np.minimum(num_ticks, np.floor(speed / limits.change))
    covered = whole * (speed - limits.change * (0.5 * whole + 0.5))
    return motion.position + np.copysign(limits.dt, motion.velocity) * covered


def braking(motion: Motion, limits: MotionLimits) -> Rows:
    """Speeds after a tick of braking [rad/s]."""
    return np.copysign(np.maximum(np.abs(motion.velocity) - limits.change, 0.0), motion.velocity)


def clipped(values: Rows, lower: Rows | Joints, upper: Rows | Joints) -> Rows:
    """Values within bounds, in half the time of `np.clip`."""
    return np.minimum(np.maximum(values, lower), upper)


def averaged(positions: Recent, limits: MotionLimits) -> Rows:
    """The commands that the newest positions make [rad], oldest first."""
    return np.add.reduce(positions * limits.weights, axis=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetInterpolator:
    """Even motion to the newest target, which is reached after a control step and held from then on."""

    start: Rows  #: Where the motion began [rad].
    end: Rows  #: The target [rad].
    begun: Times  #: When it began [s].
    stamp: Times  #: Stamp of the target [s]; an older one does not replace it.

    @classmethod
    def resting(cls, position: Rows) -> "TargetInterpolator":
        """Stay at positions [rad] until the first target."""
        none = np.zeros(len(position))
        return cls(start=position, end=position, begun=none, stamp=none - np.inf)

    def at(self, time: Times, ahead: Joints | float = 0.0) -> Rows:
        """Where it is at a time, or some time ahead of it [rad]."""
        share = ((time - self.begun)[:, None] + ahead) / CONTROL_DT
        return self.start + np.minimum(np.maximum(share, 0.0), 1.0) * (self.end - self.start)

    def rested(self, mask: Flags, position: Rows) -> "TargetInterpolator":
        """Stay at positions [rad] in the masked rows, until the next target of whatever stamp."""
        rows = mask[:, None]
        return TargetInterpolator(
            start=np.where(rows, position, self.start),
            end=np.where(rows, position, self.end),
            begun=self.begun,
            stamp=np.where(mask, -np.inf, self.stamp),
        )

    def turned(self, mask: Flags, target: Rows, now: Times, stamp: Times) -> "TargetInterpolator":
        """Begin the motion to a new target [rad] from where it is now, in the masked rows, if it is newer."""
        is_new = mask & (stamp > self.stamp)
        if not np.count_nonzero(is_new):
            return self
        return TargetInterpolator(
            start=np.where(is_new[:, None], self.at(now), self.start),
            end=np.where(is_new[:, None], target, self.end),
            begun=np.where(is_new, now, self.begun),
            stamp=np.where(is_new, stamp, self.stamp),
        )
