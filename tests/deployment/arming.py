"""How an operator gets a deployment to run, in real time and in time that passes only while it steps."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from pixel2catch.servo.limits import STOP_TIME


class Arming(ABC):
    """Somebody who hears a deployment's statuses, and tells its laboratory what to do."""

    @property
    @abstractmethod
    def status(self) -> dict[str, Any]: ...

    @property
    @abstractmethod
    def time(self) -> float:
        """Time of the laboratory [s]."""

    @abstractmethod
    def say(self, word: str) -> None: ...

    @abstractmethod
    def until(self, holds: Callable[[], bool]) -> None: ...

    def arm(self, modes: tuple[str, ...] = ("armed", "ramp", "run")) -> None:
        """All is well, the operator presses the switch and arms, and the robot is in one of the modes.

        On a machine that is busy with tests the laboratory may itself be late: then it is armed anew.
        """
        self.say("switch let go")
        self.until(lambda: "dead man" in self.status["found"])
        self.say("none")
        self.until(lambda: self.status["mode"] in ("idle", "stopped"))
        asked = [-1.0]

        def is_in_mode() -> bool:
            if self.status["mode"] in ("idle", "stopped") and self.time > asked[-1] + 2.0 * STOP_TIME:
                self.say("arm")
                asked.append(self.time)
            return self.status["mode"] in modes

        self.until(is_in_mode)
