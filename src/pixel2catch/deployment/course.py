"""From target to target in time: the command ramp of training."""

from dataclasses import dataclass

import numpy as np

from pixel2catch.deployment.motion import Rows
from pixel2catch.deployment.watchdog import Flags, Times
from pixel2catch.robot.constants import CONTROL_DT


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """Even motion to the newest target, which is reached after a control step and held from then on.

    Attributes:
        start: Where the motion began [rad].
        end: The target [rad].
        begun: When it began [s].
        stamp: Stamp of the target [s]; an older one does not replace it.
    """

    start: Rows
    end: Rows
    begun: Times
    stamp: Times

    @classmethod
    def resting(cls, position: Rows) -> "Course":
        """Stay at positions [rad] until the first target."""
        none = np.zeros(len(position))
        return cls(start=position, end=position, begun=none, stamp=none - np.inf)

    def at(self, time: Times) -> Rows:
        """Where it is at a time [rad]."""
        share = ((time - self.begun) / CONTROL_DT).clip(0.0, 1.0)
        return self.start + share[:, None] * (self.end - self.start)

    def rested(self, mask: Flags, position: Rows) -> "Course":
        """Stay at positions [rad] in the masked rows, until the next target of whatever stamp."""
        rows = mask[:, None]
        return Course(
            start=np.where(rows, position, self.start),
            end=np.where(rows, position, self.end),
            begun=self.begun,
            stamp=np.where(mask, -np.inf, self.stamp),
        )

    def turned(self, mask: Flags, target: Rows, now: Times, stamp: Times) -> "Course":
        """Begin the motion to a new target [rad] from where it is now, in the masked rows, if it is newer."""
        is_new = mask & (stamp > self.stamp)
        if not is_new.any():
            return self
        return Course(
            start=np.where(is_new[:, None], self.at(now), self.start),
            end=np.where(is_new[:, None], target, self.end),
            begun=np.where(is_new, now, self.begun),
            stamp=np.where(is_new, stamp, self.stamp),
        )
