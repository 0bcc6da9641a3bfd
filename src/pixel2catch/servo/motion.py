"""Motion of commands within limits: every tick moves towards a goal, and can always still stop in time.

A tick chooses a speed v, which moves the command by v dt. Braking from it takes the ticks v, v - a dt, and so
on, that are left above 0. All of it is exact in discrete time: rounding aside, no limit is passed.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from pixel2catch.scene.constants import CONTROL_DT

Rows = Float64[np.ndarray, "rows joints"]
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
    dt: float  #: Length of a tick [s].

    def only(self, joints: slice | Int64[np.ndarray, " some"]) -> "MotionLimits":
        """The limits of some joints."""
        values = {name: value[joints] for name, value in vars(self).items() if name != "dt"}
        return MotionLimits(**values, dt=self.dt)


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Commands of the joints, one row per robot."""

    position: Rows  #: Positions [rad].
    velocity: Rows  #: Speeds of the tick that led there [rad/s].

    def only(self, rows: Int64[np.ndarray, " some"]) -> "Motion":
        """The commands of some rows."""
        return Motion(position=self.position[rows], velocity=self.velocity[rows])

    def moved(self, velocity: Rows, dt: float) -> "Motion":
        """A tick with a speed [rad/s]."""
        return Motion(position=self.position + velocity * dt, velocity=velocity)


def fastest(
    distance: Float64[np.ndarray, "*rows joints"], limits: MotionLimits
) -> Float64[np.ndarray, "*rows joints"]:
    """Largest speed [rad/s] of a tick after which braking ends within a distance [rad], 0 or more.

    Braking from v = (n + f) a dt, n whole and 0 <= f < 1, takes ((n + 1) f + n (n + 1) / 2) a dt².
    """
    unit = limits.acceleration * limits.dt**2
    share = distance / unit
    whole = np.floor((np.sqrt(1.0 + 8.0 * share) - 1.0) / 2.0)
    part = (share - whole * (whole + 1.0) / 2.0) / (whole + 1.0)
    return (whole + part) * limits.acceleration * limits.dt


def wished(motion: Motion, goal: Rows, limits: MotionLimits) -> Rows:
    """Speeds that lead to a goal [rad] without passing it, were there no other limit [rad/s]."""
    distance = goal - motion.position
    return np.copysign(fastest(np.abs(distance), limits), distance)


def towards(motion: Motion, wish: Rows, limits: MotionLimits) -> Motion:
    """The tick whose speeds are nearest to what is wished [rad/s] and within all limits."""
    change = limits.acceleration * limits.dt
    room = np.array((motion.position - limits.lower, limits.upper - motion.position))
    below, above = np.minimum(fastest(np.maximum(room, 0.0), limits), limits.speed)
    slowest = np.maximum(motion.velocity - change, -below)
    quickest = np.minimum(motion.velocity + change, above)
    return motion.moved(wish.clip(slowest, quickest), limits.dt)


def braked(motion: Motion, limits: MotionLimits, num_ticks: Int64[np.ndarray, "rows 1"] | int = 1) -> Motion:
    """The motion after some ticks of braking, the same number or another one in each row."""
    change = limits.acceleration * limits.dt
    speed = np.abs(motion.velocity)
    whole = np.minimum(num_ticks, np.floor(speed / change))
    left = np.maximum(speed - num_ticks * change, 0.0)
    covered = (whole * speed - change * whole * (whole + 1.0) / 2.0) * limits.dt
    return Motion(
        position=motion.position + np.sign(motion.velocity) * covered,
        velocity=np.copysign(left, motion.velocity),
    )


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

    def at(self, time: Times) -> Rows:
        """Where it is at a time [rad]."""
        share = ((time - self.begun) / CONTROL_DT).clip(0.0, 1.0)
        return self.start + share[:, None] * (self.end - self.start)

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
        if not is_new.any():
            return self
        return TargetInterpolator(
            start=np.where(is_new[:, None], self.at(now), self.start),
            end=np.where(is_new[:, None], target, self.end),
            begun=np.where(is_new, now, self.begun),
            stamp=np.where(is_new, stamp, self.stamp),
        )
