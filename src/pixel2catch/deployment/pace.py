"""When to decide on an image: nearly always as long after its exposure, so that control steps are as long."""

QUANTILE = 0.9
"""Share of the images that are looked at in time. Source: ours."""

STEP = 0.0005
"""How fast the time is adapted, for each image [s]. Source: ours."""


class Pace:
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
