"""A throw of a rehearsal, led by its operator, and what is counted of many."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pixel2catch.deployment.operator import DEPTH, OperatorConsole, newest
from pixel2catch.errors import DeploymentError
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import OperatorTopics
from pixel2catch.ros2.transport import Clock, Transport
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.twin.lab_node import COMMAND, STATE

POLL = 0.005
"""Time between two looks at the network [s]. Source: ours."""


class RehearsalOperator:
    """Watches twin and deployment over the network, and asks both for things.

    Attributes:
        console: What the operator has at hand; the dead-man's switch is held.
        truth: Newest state of the twin.
        stops: Reasons of the stops that the deployment told of, newest last.
    """

    def __init__(self, transport: Transport, topics: OperatorTopics, clock: Clock) -> None:
        """Announce and listen."""
        self._clock, self.console = clock, OperatorConsole(transport, topics, clock)
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


STEP_TIME = 10.0
"""Time in which each step of a throw must be done [s]. Source: ours."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a throw ended.

    Attributes:
        seed: Its number.
        object: What was thrown; none if it never came to that.
        is_tracked: Whether the palm came near the object.
        is_success: Whether it was caught.
        stops: Why the robot stopped by itself, if it did.
        problem: Why it could not be thrown; empty if it could.
    """

    seed: int
    object: str | None
    is_tracked: bool
    is_success: bool
    stops: list[str]
    problem: str


def run_trial(operator: RehearsalOperator, seed: int) -> Outcome:
    """One throw, from an empty room to the stop after it.

    Args:
        operator: Who has it thrown.
        seed: Of the throw.
    """
    num_stops, problem, thrown = len(operator.stops), "", operator.truth.get("throw", 0)
    try:
        _prepare(operator, seed)
        operator.ask_twin(do="throw")
        operator.until(lambda: operator.truth["throw"] > thrown, STEP_TIME, "the throw")
        operator.until(lambda: operator.phase == "over", STEP_TIME, "the end of the throw")
    except DeploymentError as error:
        problem = str(error)
    truth, stops = operator.truth, operator.stops[num_stops:]
    _stop(operator)
    is_thrown = truth.get("throw", 0) > thrown
    return Outcome(
        seed=seed,
        object=truth.get("object") if is_thrown else None,
        is_tracked=is_thrown and truth["is_tracked"],
        is_success=is_thrown and truth["is_success"],
        stops=stops,
        problem=problem,
    )


def _prepare(operator: RehearsalOperator, seed: int) -> None:
    """Robot at its start and armed, the object held out and pointed at, the policy in its run."""
    operator.ask_twin(do="prepare", seed=seed)
    operator.until(lambda: operator.phase == "empty", STEP_TIME, "the empty room")
    operator.until(lambda: operator.phase == "held" and operator.truth["box"], STEP_TIME, "the object")
    operator.until(lambda: operator.mode == "idle", STEP_TIME, "an idle servo")
    operator.console.arm()
    operator.until(lambda: operator.mode == "armed", STEP_TIME, "an armed servo")
    operator.console.point(operator.truth["box"])
    operator.until(lambda: operator.mode == "run", STEP_TIME, "the policy's run")


def _stop(operator: RehearsalOperator) -> None:
    """Stop, unless that has happened, and wait until the robot stands; nobody moves it before."""
    if operator.mode in ("armed", "ramp", "run"):
        operator.console.stop()
        operator.until(lambda: operator.mode not in ("armed", "ramp", "run"), STEP_TIME, "the stop")
    operator.rest(STOP_TIME)


def rates(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Tracking and success rate with their intervals, all stops that nobody asked for, and every throw."""
    num = len(outcomes)
    report: dict[str, Any] = {"num_throws": num}
    for name, caught in (
        ("tracking_rate", [outcome.is_tracked for outcome in outcomes]),
        ("success_rate", [outcome.is_success for outcome in outcomes]),
    ):
        report[name] = sum(caught) / num
        report[f"{name}_interval"] = wilson_interval(sum(caught), num)
    report["stops"] = dict(Counter(stop for outcome in outcomes for stop in outcome.stops))
    report["problems"] = sum(bool(outcome.problem) for outcome in outcomes)
    report["throws"] = [asdict(outcome) for outcome in outcomes]
    return report


def of_twin(truth: dict[str, Any]) -> dict[str, Any]:
    """What a report says of the twin, from its last state."""
    return {
        name: truth.get(name) for name in ("joint_speed", "halts", "ignored", "late_images", "lost_images")
    }
