"""What is known of the object from look to look: since when it is not seen, and how often it jumped."""

from collections import deque
from enum import StrEnum
from math import inf

from pixel2catch.perception.extractor import Extraction
from pixel2catch.perception.plausibility import Verdict
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.limits import LOSS_TIME

LONGEST_GAP = 12 * CONTROL_DT
"""Age of the newest box from which the policy is not asked any more [s].

Source: ours. In training boxes get about 10 control steps old: images are up to 4.3 old, none comes for 3.4
more, and one in 2.6 is looked at.
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
        self._jumps: deque[bool] = deque(maxlen=NUM_LOOKS)

    def note(self, stamp: float, seen: Extraction) -> None:
        """Take note of a look at an image of this time [s]."""
        self._jumps.append(seen.verdict is Verdict.JUMP)
        if seen.verdict is Verdict.SEEN:
            self.box_stamp = stamp

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
