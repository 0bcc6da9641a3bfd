"""The operator of a rehearsal: what a person does between two throws, and with a hand on the switch."""

import json
from collections.abc import Callable
from typing import Any

from pixel2catch.deployment import messages
from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.profile import OperatorTopics
from pixel2catch.deployment.transport import Transport
from pixel2catch.errors import DeploymentError
from pixel2catch.twin.wires import COMMAND, STATE, newest

SWITCH_TIME = 0.04
"""Time between two messages of the dead-man's switch [s]. Source: ours, a fifth of what the servo waits."""

POLL = 0.005
"""Time between two looks at the network [s]. Source: ours."""

DEPTH = 64
"""Messages that are kept from one look to the next."""


class Operator:
    """Watches twin and deployment over the network, and asks both for things.

    Attributes:
        truth: Newest state of the twin.
        status: Newest status of the deployment.
        holds: Whether the dead-man's switch is held.
        stops: Reasons of the stops that the deployment told of, newest last.
    """

    def __init__(self, transport: Transport, topics: OperatorTopics, clock: Clock) -> None:
        """Announce and listen."""
        self._clock = clock
        self._switch, self._arm, self._stop, self._prompt = (
            transport.publisher(topic) for topic in (topics.dead_man, topics.arm, topics.stop, topics.prompt)
        )
        self._request = transport.publisher(COMMAND)
        self._states = transport.subscription(STATE, DEPTH)
        self._statuses = transport.subscription(topics.status, DEPTH)
        self._next_switch = -float("inf")
        self.truth: dict[str, Any] = {}
        self.status: dict[str, Any] = {}
        self.stops: list[str] = []
        self.holds = True

    @property
    def mode(self) -> str:
        """Mode of the servo."""
        return self.status.get("mode", "")

    @property
    def phase(self) -> str:
        """Phase of the throw."""
        return self.truth.get("phase", "")

    def ask_twin(self, **request: Any) -> None:
        """Ask the twin for something."""
        self._request.publish(messages.text(json.dumps(request)))

    def arm(self) -> None:
        """Ask to arm."""
        self._arm.publish(messages.boolean(True))

    def stop(self) -> None:
        """Ask to stop."""
        self._stop.publish(messages.boolean(True))

    def point(self, box: list[float]) -> None:
        """Point at the object [px]."""
        self._prompt.publish(messages.text(json.dumps({"box": box})))

    def watch(self) -> None:
        """Look at the network, and hold the switch."""
        now = self._clock.now()
        if self.holds and now >= self._next_switch:
            self._switch.publish(messages.boolean(True))
            self._next_switch = now + SWITCH_TIME
        self.truth = newest(self._states, self.truth)
        before, self.status = self.mode, newest(self._statuses, self.status)
        if self.mode == "stopped" and before != "stopped":
            self.stops.append(", ".join(self.status["stopped_by"]))

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

    def situation(self) -> str:
        """What there is to see, in a line."""
        status = {
            name: self.status.get(name) for name in ("mode", "stopped_by", "found", "refused", "message")
        }
        truth = {name: self.truth.get(name) for name in ("phase", "throw", "halted", "refused")}
        return f"deployment {json.dumps(status)}, twin {json.dumps(truth)}"
