"""`pixel2catch operate`: the operator's switch and page beside `deploy`."""

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from pixel2catch.checks import Within, require_used
from pixel2catch.cli.console import say, saying_changes
from pixel2catch.cli.link import Network
from pixel2catch.errors import InvalidValueError
from pixel2catch.installation import needs_extra
from pixel2catch.interruption import StopRequest
from pixel2catch.viewer import PageCfg

if TYPE_CHECKING:
    from pixel2catch.deployment.operator import Press

KeyCode = Annotated[int, Within(1, 767)]  #: Code of a key or button. Source: Linux, input-event-codes.h.


STOP_KEYS = (57, 1)  #: Codes of space and escape, which stop, on the page as well.
KEYS = (35, 288, 304), (30, 296, 315), (*STOP_KEYS, 289, 305)
"""Key codes that hold the switch (H, first buttons), arm (A, start buttons) and stop (second buttons)."""


@dataclass(frozen=True, kw_only=True)
class Operate:
    """Hold the dead-man's switch, arm and stop the robot.

    The device is a pedal, a gamepad or a keyboard (Linux), or a page. The robot may move while the first of
    the --keys is pressed. It stops when the key is released, the device is unplugged, or this command ends.
    The code of each pressed key is printed. The page shows the camera's image, takes prompts, and stops the
    robot. Without a device, a button of the page is the switch, released when its browser loses the focus
    or the connection. The page is no safety device.
    """

    #: Input device, such as /dev/input/by-id/usb-...-event-kbd; not needed with --web.
    device: Positional[Path | None] = None
    #: Key codes of the device: hold the switch, arm, stop. Default: H, A and space, as on the page, or a
    #: gamepad's first, start and second button. Space and escape always stop.
    keys: tuple[KeyCode, KeyCode, KeyCode] | None = None
    web: bool = False  #: Serve a page for the operator.
    page: PageCfg = field(default_factory=PageCfg)  #: Where that page is served.
    network: Network = field(default_factory=Network)  #: Connection to the deployment.

    def run(self) -> None:
        with needs_extra("deployment"):
            from pixel2catch.deployment.operator import OperatorConsole, Switches, operate_by_keys
            from pixel2catch.servo.status_words import sentence
        keys, profile = self._keys(), self.network.robot.load()
        with ExitStack() as stack:
            switches = stack.enter_context(Switches(self.device)) if self.device else None
            words = self.network.in_words(profile)
            node, clock = stack.enter_context(self.network.join("pixel2catch_operator", words))
            console = OperatorConsole(node, profile.operator, clock)
            page = None
            if self.web:
                with needs_extra("viewer"):
                    from pixel2catch.viewer.operator_page import OperatorPage
                    from pixel2catch.viewer.visitors import HeldButton
                button, title = None if switches else HeldButton(), "Pixel2Catch operator"
                page = OperatorPage(
                    self.page, title, profile, node, clock, console, button=button, words=words
                )
                stack.callback(page.close)
                say(f"open {page.address} in a browser")
            say_robot, say_change = saying_changes(), saying_changes()

            def report(presses: "list[Press]", status: dict[str, Any]) -> None:
                for press in presses:
                    say(f"key {press.code} {'pressed' if press.is_down else 'released'}")
                if status:
                    say_robot(f"deployment: {status.get('robot', 'several robots')}")
                    say_change(sentence(status))
                if page and switches:
                    page.update()

            say(f"listening to {self.device or 'the page'}; Ctrl-C ends it, and stops the robot")
            stop = stack.enter_context(StopRequest())
            if switches:
                operate_by_keys(console, switches, keys, clock, lambda: stop.is_set, report)
            elif page:
                page.operate(lambda: stop.is_set, lambda status: report([], status))

    def _keys(self) -> tuple[tuple[int, ...], ...]:
        """Return the codes that hold, arm and stop; refuse a key with two meanings, and to have no switch."""
        if self.device is None and not self.web:
            raise InvalidValueError("there is no switch: name one, such as /dev/input/event3, or add --web.")
        require_used(self, ("keys",), self.device is not None, "without a device")
        require_used(self.page, ("address",), self.web, "without --web")
        if self.keys is None:
            return KEYS
        hold, arm, stop = self.keys
        if len({*self.keys}) < len(self.keys) or {hold, arm} & {*STOP_KEYS}:
            fix = "give three different ones; space (57) and escape (1) stop"
            raise InvalidValueError(f"--keys {hold} {arm} {stop}: {fix}.")
        return (hold,), (arm,), (stop, *STOP_KEYS)
