"""An operator at a pedal: keys to switches, until the device or the operator is gone."""

from collections.abc import Callable
from typing import Any

from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.console import Console
from pixel2catch.deployment.switches import Keys, Press, Switches

POLL = 0.005
"""Time between two looks at the keys [s]. Source: ours."""


class Operating:
    """Holds, arms and stops as the keys say."""

    def __init__(self, console: Console, switches: Switches, keys: Keys) -> None:
        """Begin with the switch let go, whatever is pressed already."""
        self._console, self._switches, self._keys = console, switches, keys

    def run(
        self, clock: Clock, is_over: Callable[[], bool], report: Callable[[list[Press], dict[str, Any]], None]
    ) -> None:
        """Look at the keys until it is over, and let go of the switch then.

        Args:
            clock: The clock of the deployment.
            is_over: Asked all the time whether to end.
            report: Gets what was pressed and the newest status, all the time.

        Raises:
            DeploymentError: The device is gone.
        """
        try:
            while not is_over():
                report(self._look(), self._console.status)
                clock.sleep_until(clock.now() + POLL)
        finally:
            self._console.holds = False
            self._console.watch()

    def _look(self) -> list[Press]:
        """One look at the keys."""
        console, keys = self._console, self._keys
        presses = self._switches.poll()
        down = {press.code for press in presses if press.is_down}
        console.holds = not self._switches.pressed.isdisjoint(keys.hold)
        console.watch()
        if not down.isdisjoint(keys.stop):
            console.stop()
        elif not down.isdisjoint(keys.arm):
            console.arm()
        return presses
