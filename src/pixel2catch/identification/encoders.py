"""What lies between the motion of joints and what was recorded of it: play, and clocks that drift apart."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

PerJoint = Float[np.ndarray, " num_joints"]
Positions = Float[np.ndarray, "num_times num_joints"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Encoders:
    """How joints were measured."""

    #: width of the play between servo and encoder [rad]: the encoder stays behind by half of it, whichever
    #: way the joint moves
    play: PerJoint
    #: by how much the clock of the measurements is faster than that of the commands, as a share of the time
    #: since the first measurement
    drift: Float[np.ndarray, "num_recordings num_joints"]

    @classmethod
    def perfect(cls, num_recordings: int, num_joints: int) -> "Encoders":
        """Neither play nor drift."""
        return cls(play=np.zeros(num_joints), drift=np.zeros((num_recordings, num_joints)))


def behind_play(positions: Positions, play: PerJoint) -> Positions:
    """What encoders behind a play [rad] read while their joints are at some positions [rad]."""
    if not play.any():
        return positions
    low, high = positions - play / 2, positions + play / 2
    read, now = np.empty_like(positions), positions[0]
    for k in range(len(positions)):
        now = np.minimum(np.maximum(now, low[k]), high[k])
        read[k] = now
    return read


def encoders_of(columns: Float[np.ndarray, "num_joints num_columns"]) -> Encoders:
    """From columns: the play of each joint, then the drift in each recording."""
    return Encoders(play=columns[:, 0].copy(), drift=columns[:, 1:].T.copy())
