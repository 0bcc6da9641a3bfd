"""How far, how fast and how hard each joint is excited."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pixel2catch.identification.recording import JOINT_SPECS
from pixel2catch.identification.trajectory import largest_step
from pixel2catch.robot.constants import HAND_JOINTS

ARM_MARGIN, HAND_MARGIN = 0.03, 0.06
"""Distance that commands keep from a joint's limits [rad]. Source: ours; a fast arm shakes the hand."""

ARM_SWING, HAND_SWING = 0.35, 0.4
"""Farthest from the middle of the excitation [rad].

Source: ours; the palm stays within 0.5 m of its start and 0.18 m above the table, and fingers do not meet.
"""

ARM_ACCELERATION, HAND_ACCELERATION = 15.0, 100.0
"""Largest acceleration of a smooth command [rad/s²].

Source: ours. UR limits the torque only: 15 rad/s² of all joints at once take 51 N·m of the UR5e's 150; 100
rad/s² take 0.22 of the hand's 0.5 N·m at most. Both are several times what dry friction hides.
"""

SPEED_SHARE = 0.8
"""Share of the speed limit that commands use at full speed. Source: ours; joints pull at each other."""

HAND = frozenset(spec.name for spec in HAND_JOINTS)
"""Names of the hand's joints."""

Row = Float64[np.ndarray, " num_joints"]


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """What commands of some joints keep to; one entry per joint.

    Attributes:
        joints: Their names.
        home: Start pose [rad].
        center: Middle of the excitation [rad]: next to the start pose, with room for `swing` on both sides.
        swing: Farthest from the middle [rad].
        speed: Largest speed of a command [rad/s].
        acceleration: Largest acceleration of a smooth command [rad/s²].
        step: Largest jump of a command [rad].
    """

    joints: tuple[str, ...]
    home: Row
    center: Row
    swing: Row
    speed: Row
    acceleration: Row
    step: Row

    @classmethod
    def of(cls, joints: Sequence[str], speed: float, shrunk: Mapping[str, float]) -> "Envelope":
        """The envelope of some joints.

        Args:
            joints: Their names, in joint order.
            speed: Factor on speed, acceleration and jumps; 1 is full.
            shrunk: Factors on everything, by joint; 1 where there is none.
        """
        specs = [JOINT_SPECS[name] for name in joints]
        is_hand = np.array([name in HAND for name in joints])
        share = np.array([shrunk.get(name, 1.0) for name in joints])
        lower, upper, home = np.array([(spec.lower, spec.upper, spec.home) for spec in specs]).T
        margin = np.where(is_hand, HAND_MARGIN, ARM_MARGIN)
        lower, upper = lower + margin, upper - margin
        swing = share * np.minimum(np.where(is_hand, HAND_SWING, ARM_SWING), (upper - lower) / 2)
        pace = speed * share
        return cls(
            joints=tuple(joints),
            home=home,
            center=np.clip(home, lower + swing, upper - swing),
            swing=swing,
            speed=pace * SPEED_SHARE * np.array([spec.velocity_limit for spec in specs]),
            acceleration=pace * np.where(is_hand, HAND_ACCELERATION, ARM_ACCELERATION),
            step=pace * np.array([largest_step(spec) for spec in specs]),
        )

    def only(self, is_moved: np.ndarray) -> "Envelope":
        """The same with the other joints at rest."""
        rows = {name: np.where(is_moved, getattr(self, name), 0.0) for name in ("swing", "step")}
        return dataclasses.replace(self, **rows)
