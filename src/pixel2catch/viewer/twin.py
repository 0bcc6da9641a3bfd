"""A web page that shows the twin, what the deployment sees and does, and has buttons to throw. Needs viser.

It only listens and asks on the network, as any other node; its process takes nothing from the twin's. One
button does all that an operator does for a throw; the others do it step by step.
"""

import json
import sys
import time
from collections import deque
from threading import Thread
from typing import Any, NoReturn

from pixel2catch.deployment.operator import newest
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, Clock, RealClock, Transport, make_transport
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.twin.lab_node import COMMAND, STATE
from pixel2catch.twin.rehearsal import RehearsalOperator, run_trial
from pixel2catch.viewer.config import PageCfg
from pixel2catch.viewer.server import open_server
from pixel2catch.viewer.wire import WireView

PERIOD = 1 / 15  #: Real time between two changes of the page [s]. Source: ours, light on a shared machine.
REQUESTS = ("prepare", "throw", "protective_stop", "resume")  #: What the twin is asked for by buttons.


class TwinPage:
    """The page; `update` makes it current."""

    def __init__(
        self, cfg: PageCfg, scene: SceneCfg, profile: Profile, transport: Transport, clock: Clock
    ) -> None:
        """Serve the page of a scene, by the clock of twin and deployment."""
        self._operator = RehearsalOperator(transport, profile.operator, clock)
        self.console = self._operator.console  #: One for the page and its throws: the servo heeds no second.
        self.trial: Thread | None = None  #: The throw that goes on by itself, or did.
        self._states = transport.subscription(STATE)
        self._commands = transport.publisher(COMMAND)
        self._wishes: deque[dict[str, Any]] = deque()
        self._state: dict[str, Any] = {}
        self._page = open_server(cfg, "Pixel2Catch twin")
        self._server = self._page.viser
        self.wire = WireView(self._server, scene, profile, transport, clock)  #: What is shown.
        self._build_panel()

    @property
    def address(self) -> str:
        """Where it is served."""
        return self._page.address

    def update(self) -> None:
        """Show what has arrived, and send what was clicked."""
        while self._wishes:
            self._commands.publish(messages.text(json.dumps(self._wishes.popleft())))
        self._state = newest(self._states, self._state)
        if not self._is_in_trial:
            self._operator.watch()
        self.wire.update(self.console.status, self._state)

    def ask(self, name: str) -> None:
        """Ask the twin for one of `REQUESTS`, with the next update; any thread may call this."""
        wish: dict[str, Any] = {"do": name}
        if name == "prepare":
            wish["seed"] = self._next_seed()
        self._wishes.append(wish)

    def catch(self) -> None:
        """Do all that an operator does for a throw, beside the page; nothing while that goes on."""
        if not self._is_in_trial:
            self.trial = Thread(target=run_trial, args=(self._operator, self._next_seed()), daemon=True)
            self.trial.start()

    @property
    def _is_in_trial(self) -> bool:
        return self.trial is not None and self.trial.is_alive()

    def point(self) -> None:
        """Point at the object, if the camera sees it."""
        if box := self._state.get("box"):
            self.console.point(box)

    def hold(self, is_held: bool) -> None:
        """Hold the dead-man's switch, or let it go."""
        self.console.holds = is_held

    def _next_seed(self) -> int:
        seed = int(self.seed.value)
        self.seed.value += 1
        return seed

    def close(self) -> None:
        """End the page."""
        self._page.close()

    def _build_panel(self) -> None:
        """The camera's image, the states, the buttons."""
        gui = self._server.gui
        self.seed = gui.add_number("seed of the next throw", 0, min=0, step=1)
        gui.add_button("throw and catch").on_click(lambda _: self.catch())
        with gui.add_folder("step by step", expand_by_default=False):
            switch = gui.add_checkbox("hold the dead-man's switch", False)
            switch.on_update(lambda _: self.hold(switch.value))
            for name in REQUESTS:
                gui.add_button(name.replace("_", " ")).on_click(lambda _, name=name: self.ask(name))
            gui.add_button("arm").on_click(lambda _: self.console.arm())
            gui.add_button("point at the object").on_click(lambda _: self.point())
            gui.add_button("stop").on_click(lambda _: self.console.stop())
        self.wire.add_states()


def serve_page(cfg: PageCfg, scene: SceneCfg, profile: Profile, rate: float) -> NoReturn:
    """Serve the page until this process is ended."""
    clock = RealClock(rate)
    with make_transport("dds", "pixel2catch_page", LOOPBACK, clock) as node:
        page = TwinPage(cfg, scene, profile, node, clock)
        print(f"the twin's page: {page.address}", file=sys.stderr, flush=True)
        while True:
            page.update()
            time.sleep(PERIOD)
