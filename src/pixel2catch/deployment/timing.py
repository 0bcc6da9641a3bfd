"""When to decide: control steps are equally long, as in training, and nearly all images come in time."""

from collections import deque
from math import floor, inf

import numpy as np

from pixel2catch.scene.constants import CONTROL_DT

QUANTILE = 0.9
"""Share of the images that are looked at in time. Source: ours."""

STEP = 0.0005
"""How fast the time is adapted, for each image [s]. Source: ours."""


class DecisionDelay:
    """Learns how old images are when they have been looked at, and waits for those that are done sooner.

    What the policy sees of the object's speed is what has changed since the last control step. In training
    steps are equally long; perception takes now less and now more.

    Attributes:
        age: How old an image is when it is decided on [s]; the quantile of the ages so far.
    """

    def __init__(self, longest: float) -> None:
        """Wait for nothing yet: the first looks, which are slow, count no more than others.

        Args:
            longest: Age up to which waiting costs nothing [s].
        """
        self._longest = longest
        self.age = 0.0

    def moment(self, stamp: float, now: float) -> float:
        """When to decide on an image [s]; it may be over.

        Args:
            stamp: When it was taken [s].
            now: When it has been looked at [s].
        """
        age = now - stamp
        change = QUANTILE if age > self.age else QUANTILE - 1.0
        self.age = min(self.age + STEP * change, self._longest)
        return stamp + self.age


NUM_LOOKS = 60
"""Looks that a timer learns from: two to four seconds. Source: ours."""

SHIFT = 0.0005
"""How far a control step may be longer or shorter than it should be [s]. Source: ours."""


class DecisionTimer:
    """Says when to decide, once in every control step, whether there is a new image or not.

    Where images come as regularly, it decides as long after their exposure as nine of ten of the last looks
    took, or whole control steps later: perception may take longer than a step.

    Attributes:
        due: When to decide next [s].
    """

    def __init__(self, begin: float) -> None:
        """Decide first at this time [s]."""
        self.due = begin
        self._ages: deque[float] = deque(maxlen=NUM_LOOKS)
        self._moment = begin

    def learn(self, stamp: float, end: float) -> None:
        """Learn from a look at an image.

        Args:
            stamp: When the image was taken [s].
            end: When it had been looked at [s].
        """
        self._ages.append(end - stamp)
        self._moment = stamp + float(np.quantile(self._ages, QUANTILE))

    def advance(self, now: float, *, is_even: bool) -> None:
        """A decision was made: set the time of the next one.

        Args:
            now: When it was made [s].
            is_even: Whether the step to the next one has to be as long as others.
        """
        num_steps = max(floor((now - self.due) / CONTROL_DT), 0) + 1  # what is over is left out
        self.due += num_steps * CONTROL_DT
        error = (self._moment - self.due + 0.5 * CONTROL_DT) % CONTROL_DT - 0.5 * CONTROL_DT
        most = SHIFT if is_even else inf
        self.due += min(max(error, -most), most)
