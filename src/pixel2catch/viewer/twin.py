"""The twin's page: an operator's page with buttons for the simulated thrower and robot.

One button does all steps of a throw, others do one step each. Two more buttons stop the robots as after a
collision, and run their programs again.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from threading import Thread
from typing import Any, final

import torch

from pixel2catch.errors import DeploymentError
from pixel2catch.interruption import end_with_parent, without_interrupts
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import LOOPBACK, Clock, RealClock, Transport, make_transport
from pixel2catch.twin.rehearsal import RehearsalOperator, run_trial
from pixel2catch.twin.simulated_lab import Phase
from pixel2catch.viewer import PageCfg
from pixel2catch.viewer.operator_page import OperatorPage
from pixel2catch.viewer.server import listening_address
from pixel2catch.viewer.visitors import HeldButton

REQUESTS = "catch, seed, show, prepare, throw, protective_stop, resume"  #: Requests of the twin's page.


@final
class TwinPage:
    """The page; `update` refreshes it."""

    def __init__(self, cfg: PageCfg, profile: Profile, transport: Transport, clock: Clock) -> None:
        #: One operator for page and throws, because the servo obeys only one.
        self.operator = RehearsalOperator(transport, profile.operator, clock)
        self.trial: Thread | None = None  #: Thread of the newest automatic throw.
        self.seed = 0  #: Seed of the next throw.
        self.outcomes: dict[str, str] = {}  #: Outcomes of throws by number.
        self._problem = ""
        title, button = "Pixel2Catch twin", HeldButton()
        #: The operator's page.
        self.page = OperatorPage(
            cfg, title, profile, transport, clock, self.operator, button=button, more=self._handle
        )

    def update(self) -> None:
        """Show new messages, and pass on the state of the switch."""
        if not self._is_in_trial:
            self.operator.holds = self.page.is_held
            self.operator.watch()
        truth = self.operator.truth
        if truth.get("phase") == Phase.OVER:
            self.outcomes[str(truth.get("throw"))] = str(truth.get("outcome"))
        self.page.update(self._words(truth))

    def catch(self) -> None:
        """Run a whole throw in a thread, unless one is running."""
        if not self._is_in_trial:
            self.trial = Thread(target=self._run_throw, args=(self._next_seed(),), daemon=True)
            self.trial.start()

    def _run_throw(self, seed: int) -> None:
        self._problem = ""
        self._problem = run_trial(self.operator, seed, is_cycle="cycle" in self.operator.status).problem

    @property
    def _is_in_trial(self) -> bool:
        return self.trial is not None and self.trial.is_alive()

    def _next_seed(self) -> int:
        self.seed += 1
        return self.seed - 1

    def _words(self, truth: dict[str, Any]) -> dict[str, Any]:
        outcomes = [*self.outcomes.values()]
        said = (self._problem.partition(":")[0], str(truth.get("refused", "")))
        halted = "the robot's program is halted: press resume" if truth.get("halted") else ""
        num_caught = sum(outcome == "caught" for outcome in outcomes)
        return {
            "seed": self.seed,
            "throw": truth.get("summary", "no message from the twin"),
            "result": f"{outcomes[-1]}; {num_caught} of {len(outcomes)} caught" if outcomes else "none",
            "trouble": "; ".join(filter(None, (*said, halted))),
            "is_busy": self._is_in_trial,
        }

    def _handle(self, request: dict[str, Any]) -> None:
        match request:
            case {"do": "catch"}:
                self.catch()
            case {"do": "seed", "seed": int(seed)} if 0 <= seed < 2**31:
                self.seed = seed
            case {"do": "show"} if box := self.operator.truth.get("box"):
                self.operator.point(box)
            case {"do": "show"}:
                raise DeploymentError("the camera sees no object: prepare a throw first")
            case {"do": "prepare"}:
                self.operator.request(do="prepare", seed=self._next_seed())
            case {"do": "throw" | "protective_stop" | "resume" as name}:
                self.operator.request(do=name)
            case _:
                raise DeploymentError(f"{request} is no request; valid: {REQUESTS}")


@contextmanager
def twin_page(cfg: PageCfg, profile: Profile, rate: float) -> Iterator[None]:
    """Serve the page in a process that ends with the context."""
    listening_address(cfg.host)
    process = get_context("spawn").Process(target=_serve, args=(cfg, profile, rate), daemon=True)
    with without_interrupts():
        process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


def _serve(cfg: PageCfg, profile: Profile, rate: float) -> None:
    end_with_parent()
    torch.set_num_threads(1)
    clock = RealClock(rate)
    with make_transport("pixel2catch_page", LOOPBACK, clock) as node:
        page = TwinPage(cfg, profile, node, clock)
        print(f"the twin's page: {page.page.address}", file=sys.stderr, flush=True)
        while True:
            page.update()
            page.page.rest()
