"""`pixel2catch operate`: a pedal or a gamepad as the dead-man's switch of `deploy`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from pixel2catch.cli.link import Network
from pixel2catch.deployment.switches import Keys

if TYPE_CHECKING:
    from pixel2catch.deployment.switches import Press


@dataclass(frozen=True, kw_only=True)
class Operate:
    """Hold the dead-man's switch, arm and stop with a pedal, a gamepad or a keyboard (Linux).

    While a key of --hold is pressed the robot may move; when it is released, or the device is unplugged, or
    this command ends, the robot stops. Keys are given by the codes that this command shows when they are
    pressed.
    """

    device: Positional[Path]  #: Input device, such as /dev/input/by-id/usb-...-event-kbd.
    keys: Keys = field(default_factory=Keys)  #: What the keys do.
    network: Network = field(default_factory=Network)  #: How the deployment is reached.

    def run(self) -> None:
        """Operate until Ctrl-C, and say when something changes."""
        from pixel2catch.cli.console import say
        from pixel2catch.cli.deploy import sentence
        from pixel2catch.cli.extras import needs_extra
        from pixel2catch.interruption import StopRequest

        with needs_extra("deployment"):
            from pixel2catch.deployment.operator import OperatorConsole, operate_by_keys
            from pixel2catch.deployment.switches import Switches
        profile = self.network.robot.load()
        said = ""

        def tell(presses: "list[Press]", status: dict[str, Any]) -> None:
            nonlocal said
            for press in presses:
                say(f"key {press.code} {'pressed' if press.is_down else 'released'}")
            if status and (line := sentence(status)) != said:
                said = line
                say(line)

        with Switches(self.device) as switches, self.network.join("pixel2catch_operator") as (node, clock):
            console = OperatorConsole(node, profile.operator, clock)
            say(f"listening to {self.device}; Ctrl-C ends it, and stops the robot")
            with StopRequest() as stop:
                operate_by_keys(console, switches, self.keys, clock, lambda: stop.is_set, tell)
