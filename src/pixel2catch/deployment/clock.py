"""The clock of a deployment: real time for a robot; for a twin real time, slower, or as it is told."""

import time
from abc import ABC, abstractmethod
from typing import final

from pixel2catch.errors import InvalidValueError


class Clock(ABC):
    """Seconds that everything which takes part in a deployment agrees on."""

    @abstractmethod
    def now(self) -> float:
        """Monotonic time [s]: for ages, periods and deadlines."""

    @abstractmethod
    def stamp(self) -> float:
        """Time of day [s]: for the headers of messages, which other machines compare with their own."""

    @abstractmethod
    def sleep_until(self, moment: float) -> None:
        """Wait for a moment of `now`; return at once if it is over."""


@final
class RealClock(Clock):
    """Seconds that pass at a stated rate, the same ones in every process of one machine.

    Attributes:
        rate: Seconds of this clock in a real second: 1 for a robot, less where a twin is too slow.
    """

    def __init__(self, rate: float = 1.0) -> None:
        """Begin.

        Raises:
            InvalidValueError: The rate is out of range.
        """
        if not 0.0 < rate <= 1.0:
            raise InvalidValueError(f"the clock's rate is {rate:g}; it must be more than 0 and at most 1")
        self.rate = rate

    def now(self) -> float:
        """See `Clock.now`."""
        return self.rate * time.monotonic()

    def stamp(self) -> float:
        """See `Clock.stamp`."""
        return self.rate * time.time()

    def sleep_until(self, moment: float) -> None:
        """See `Clock.sleep_until`."""
        left = (moment - self.now()) / self.rate
        if left > 0.0:
            time.sleep(left)
