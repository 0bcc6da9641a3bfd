"""What is known of the object from look to look: how long it is unseen or still, and how often it jumped."""

from collections import deque
from enum import StrEnum
from math import inf

import numpy as np

from pixel2catch.camera.image import Box, Verdict
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.limits import LOSS_TIME

LONGEST_GAP = 0.7
"""Age of the newest box from which the policy is not asked any more [s].

Source: ours, from rehearsals: with gaps of 13 control steps in the middle of the flight about half of the
throws are caught, and none where it is not asked from 0.4 s on.
"""

MOTION = 6.0  #: How far the middle of a box is from where it was if the object has moved [px]. Source: ours.

STILL_TIME = (ThrowCfg().hover_steps[1] + 1) * CONTROL_DT
"""Time after which an object that is still is held, or caught, and the policy is not asked [s].

Source: ours, the longest wait in the paper's task, which the shipped policies were trained with: where boxes
are noisy they drift away in a longer one (experiments/LOG.md). The first image of a flight, 15 px on, ends
it.
"""

NUM_JUMPS, NUM_LOOKS = 5, 30  #: So many jumps in so many looks, a second, are no object's. Source: ours.


class Sight(StrEnum):
    """What is known of the object now."""

    NEVER = "never seen"
    SEEN = "seen"
    SEARCHING = "searching"
    LOST = "lost"


class SightTrack:
    """When the object was seen in a throw, and whether what is seen can be one object."""

    def __init__(self) -> None:
        """Begin before the throw."""
        #: When the newest image was taken in which the object was seen [s]; minus infinity before.
        self.box_stamp = -inf
        self._place, self._moved = np.full(2, inf), -inf
        self._jumps: deque[bool] = deque(maxlen=NUM_LOOKS)

    def note(self, box: Box) -> None:
        """Take note of the box of the next image."""
        stamp = box.stamp
        self._jumps.append(box.verdict is Verdict.JUMP)
        if box.verdict is Verdict.SEEN:
            place = np.reshape(box.edges, (2, 2)).mean(axis=0)
            if np.abs(place - self._place).max() > MOTION or stamp - self.box_stamp > LONGEST_GAP:
                self._place, self._moved = place, stamp
            self.box_stamp = stamp

    @property
    def is_still(self) -> bool:
        """Whether the object has been at one place for `STILL_TIME`."""
        return self.box_stamp - self._moved >= STILL_TIME

    @property
    def problem(self) -> str:
        """Why perception cannot be trusted; empty if it can."""
        if sum(self._jumps) < NUM_JUMPS:
            return ""
        return (
            "the object is seen, again and again, where no thrown one can be so soon: is there another thing "
            "of its looks, or does the light flicker? 'pixel2catch track' shows what is seen."
        )

    def at(self, now: float) -> Sight:
        """What is known of the object at a time [s]."""
        age = now - self.box_stamp
        if age == inf:
            return Sight.NEVER
        if age <= LONGEST_GAP:
            return Sight.SEEN
        return Sight.SEARCHING if age <= LOSS_TIME else Sight.LOST
