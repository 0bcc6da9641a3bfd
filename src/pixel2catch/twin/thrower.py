"""The thrower, who stands and waits for as long as the operator wants."""

from dataclasses import dataclass
from math import inf

import numpy as np
from jaxtyping import Float

from pixel2catch.rendering.room import BYSTANDER_JOINTS, Bystanders

ARM = BYSTANDER_JOINTS.index("thrower_arm")


@dataclass(frozen=True, kw_only=True)
class Thrower:
    """The thrower and the hanging ball, from the beginning of the twin's time on.

    Attributes:
        bystanders: Where they stand.
        release: When the arm let go [s]; infinite before.
    """

    bystanders: Bystanders
    release: float = inf

    def joint_pos(self, time: float) -> Float[np.ndarray, "6"]:
        """Positions of their joints [m, rad] at a time of the twin [s]."""
        pos = self.bystanders.joint_pos(-time)  # swaying, with the arm at rest
        if time > self.release:
            pos[ARM] = self.bystanders.joint_pos(time - self.release)[ARM]
        return pos
