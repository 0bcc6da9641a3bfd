"""The operator of a rehearsal: what a person does between two throws, and with a hand on the switch."""

import json
from collections.abc import Callable
from typing import Any

from pixel2catch.deployment import messages
from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.console import DEPTH, Console, newest
from pixel2catch.deployment.profile import OperatorTopics
from pixel2catch.deployment.transport import Transport
from pixel2catch.errors import DeploymentError
from pixel2catch.twin.wires import COMMAND, STATE

POLL = 0.005
"""Time between two looks at the network [s]. Source: ours."""


class Operator:
    """Watches twin and deployment over the network, and asks both for things.

    Attributes:
        console: What the operator has at hand; the dead-man's switch is held.
        truth: Newest state of the twin.
        stops: Reasons of the stops that the deployment told of, newest last.
    """

    def __init__(self, transport: Transport, topics: OperatorTopics, clock: Clock) -> None:
        """Announce and listen."""
        self._clock, self.console = clock, Console(transport, topics, clock)
        self._request = transport.publisher(COMMAND)
        self._states = transport.subscription(STATE, DEPTH)
        self.console.holds = True
        self.truth: dict[str, Any] = {}
        self.stops: list[str] = []

    @property
    def mode(self) -> str:
        """Mode of the servo."""
        return self.console.mode

    @property
    def phase(self) -> str:
        """Phase of the throw."""
        return self.truth.get("phase", "")

    def ask_twin(self, **request: Any) -> None:
        """Ask the twin for something."""
        self._request.publish(messages.text(json.dumps(request)))

    def watch(self) -> None:
        """Look at the network, and hold the switch."""
        self.truth = newest(self._states, self.truth)
        before = self.mode
        self.console.watch()
        if self.mode == "stopped" and before != "stopped":
            self.stops.append(", ".join(self.console.status["stopped_by"]))

    def until(self, condition: Callable[[], bool], seconds: float, what: str) -> None:
        """Watch until something holds.

        Args:
            condition: What is waited for.
            seconds: How long at most [s].
            what: What it is, for the error.

        Raises:
            DeploymentError: It did not come about.
        """
        end = self._clock.now() + seconds
        while not condition():
            if self._clock.now() > end:
                raise DeploymentError(f"{what} did not come within {seconds:g} s: {self.situation()}")
            self.watch()
            self._clock.sleep_until(self._clock.now() + POLL)

    def rest(self, seconds: float) -> None:
        """Watch for a while [s]."""
        end = self._clock.now() + seconds
        self.until(lambda: self._clock.now() >= end, seconds + POLL, "the end of a rest")

    def situation(self) -> str:
        """What there is to see, in a line."""
        said = self.console.status
        status = {name: said.get(name) for name in ("mode", "stopped_by", "found", "refused", "message")}
        truth = {name: self.truth.get(name) for name in ("phase", "throw", "halted", "refused")}
        return f"deployment {json.dumps(status)}, twin {json.dumps(truth)}"
