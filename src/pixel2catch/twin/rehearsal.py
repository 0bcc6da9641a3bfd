"""A rehearsal: an operator, throws by number, what is counted of them; and twin and deployment as processes.

`stepped` has the same in one process, without real time.
"""

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pixel2catch.deployment.operator import DEPTH, OperatorConsole, newest
from pixel2catch.errors import DeploymentError
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.ros2 import messages
from pixel2catch.ros2.factory import make_transport
from pixel2catch.ros2.profile import OperatorTopics, Profile
from pixel2catch.ros2.transport import LOOPBACK, Clock, RealClock, Transport
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.twin.config import RehearsalCfg
from pixel2catch.twin.lab_node import COMMAND, PROFILE, STATE

POLL = 0.005  #: Time between two looks at the network [s]. Source: ours.
STEP_TIME = 10.0  #: Time in which each step of a throw must be done [s]. Source: ours.
START_TIME = 600.0  #: Real time for both processes to appear [s]: loaded machines are slow. Source: ours.
END_TIME = 120.0  #: Real time in which a process must have ended [s].


class RehearsalOperator:
    """Watches twin and deployment over the network, and asks both for things."""

    def __init__(self, transport: Transport, topics: OperatorTopics, clock: Clock) -> None:
        """Announce and listen."""
        self._clock, self.console = clock, OperatorConsole(transport, topics, clock)
        self._request = transport.publisher(COMMAND)
        self._states = transport.subscription(STATE, DEPTH)
        self.truth: dict[str, Any] = {}  #: Newest state of the twin.
        self.stops: list[str] = []  #: Reasons of the stops that the deployment told of, newest last.

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
        """Look at the network, and go on holding the switch, if it is held."""
        self.truth = newest(self._states.take(), self.truth)
        before = self.mode
        self.console.watch()
        if self.mode == "stopped" and before != "stopped":
            self.stops.append(", ".join(self.console.status["stopped_by"]))

    def until(self, condition: Callable[[], bool], seconds: float, what: str) -> None:
        """Watch until a condition holds, for so many seconds at most; an error says what did not come.

        Raises:
            DeploymentError: It did not come about.
        """
        end = self._clock.now() + seconds
        while not condition():
            if self._clock.now() > end:
                said, true = self.console.status, self.truth
                status = {
                    name: said.get(name) for name in ("mode", "stopped_by", "found", "refused", "message")
                }
                truth = {name: true.get(name) for name in ("phase", "throw", "halted", "refused")}
                raise DeploymentError(
                    f"{what} did not come within {seconds:g} s: "
                    f"deployment {json.dumps(status)}, twin {json.dumps(truth)}"
                )
            self.watch()
            self._clock.sleep_until(self._clock.now() + POLL)

    def rest(self, seconds: float) -> None:
        """Watch for a while [s]."""
        end = self._clock.now() + seconds
        self.until(lambda: self._clock.now() >= end, seconds + POLL, "the end of a rest")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a throw ended."""

    seed: int  #: Its number.
    object: str | None  #: What was thrown; none if it never came to that.
    is_tracked: bool  #: Whether the palm came near the object.
    is_success: bool  #: Whether it was caught.
    stops: list[str]  #: Why the robot stopped by itself, if it did.
    problem: str  #: Why it could not be thrown; empty if it could.


def run_trial(operator: RehearsalOperator, seed: int, held: float = 0.0) -> Outcome:
    """One throw, from an empty room to the stop after it, of what is held for some time before [s]."""
    num_stops, problem, thrown = len(operator.stops), "", operator.truth.get("throw", 0)
    try:
        _prepare(operator, seed)
        operator.rest(held)
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
    """Robot at its start and armed, the object held out and pointed at, the policy in its run.

    The switch is pressed anew for every throw, as the servo wants it after a stop.
    """
    operator.ask_twin(do="prepare", seed=seed)
    operator.until(lambda: operator.phase == "empty", STEP_TIME, "the empty room")
    operator.until(lambda: operator.phase == "held" and operator.truth["box"], STEP_TIME, "the object")
    operator.until(lambda: operator.mode == "idle", STEP_TIME, "an idle servo")
    operator.console.holds = True
    operator.until(lambda: "dead man" not in operator.console.status["found"], STEP_TIME, "a held switch")
    operator.console.arm()
    operator.until(lambda: operator.mode == "armed", STEP_TIME, "an armed servo")
    operator.console.point(operator.truth["box"])
    operator.until(lambda: operator.mode == "run", STEP_TIME, "the policy's run")


def _stop(operator: RehearsalOperator) -> None:
    """Stop, unless that has happened, and wait until the robot stands; nobody moves it before."""
    if operator.mode in ("armed", "ramp", "run"):
        operator.console.stop()
        operator.until(lambda: operator.mode not in ("armed", "ramp", "run"), STEP_TIME, "the stop")
    operator.console.holds = False
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


def rehearse(
    cfg: RehearsalCfg, policy: str | None, logs: Path, report: Callable[[Outcome], None]
) -> dict[str, Any]:
    """Throw with twin and deployment as processes of their own, and return the report, for programs.

    The policy is what both commands take, and what they print goes to the logs' folder.

    Raises:
        DeploymentError: A process did not start, or ended early.
    """
    os.environ["ROS_DOMAIN_ID"] = str(cfg.domain)
    clock, begin = RealClock(cfg.clock), time.perf_counter()
    common = ("--clock", f"{cfg.clock:g}")
    twin_args = ["--seed", str(cfg.seed), "--objects", *cfg.task.objects]
    twin_args += ["--policy", policy] if policy else []
    twin_args += ["--dynamics", str(cfg.task.dynamics)] if cfg.task.dynamics else []
    deploy_args = ["--json", *([policy] if policy else [])]
    deploy_args += ["--record", str(cfg.record)] if cfg.record else []
    with ExitStack() as stack:
        twin = stack.enter_context(_process(logs, "twin", *common, *twin_args))
        deploy = stack.enter_context(_process(logs, "deploy", *common, *deploy_args))
        node = stack.enter_context(make_transport("dds", "pixel2catch_operator", LOOPBACK, clock))
        operator = RehearsalOperator(node, Profile.load(PROFILE).operator, clock)
        _wait_for_both(operator, (twin, deploy), cfg.clock, logs)
        outcomes = []
        for seed in range(cfg.seed, cfg.seed + cfg.throws):
            outcomes.append(run_trial(operator, seed, cfg.held_seconds))
            report(outcomes[-1])
            _require_alive((twin, deploy), logs)
        truth = operator.truth
    return {
        **rates(outcomes),
        "clock": cfg.clock,
        "seconds": time.perf_counter() - begin,
        "deploy": _summary(logs / "deploy.txt"),
        "twin": of_twin(truth),
    }


@contextmanager
def _process(logs: Path, command: str, *args: str) -> Iterator[subprocess.Popen[bytes]]:
    """A command of this package as a process that is ended at the end."""
    with open(logs / f"{command}.txt", "wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "pixel2catch", command, *args], stdout=file, stderr=subprocess.STDOUT
        )
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(END_TIME)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_for_both(
    operator: RehearsalOperator, processes: Sequence[subprocess.Popen[bytes]], clock: float, logs: Path
) -> None:
    """Wait until twin and deployment are heard of, and the servo ticks."""

    def are_there() -> bool:
        _require_alive(processes, logs)
        has_image = operator.console.status.get("verdict") != "no image"
        return bool(operator.truth) and operator.mode == "idle" and has_image

    operator.until(are_there, clock * START_TIME, "twin and deployment")


def _require_alive(processes: Sequence[subprocess.Popen[bytes]], logs: Path) -> None:
    for process in processes:
        if process.poll() is not None:
            name = process.args[3]  # type: ignore[index]
            lines = (logs / f"{name}.txt").read_text(errors="replace").strip().splitlines()
            said = lines[-1] if lines else "nothing"
            raise DeploymentError(f"'pixel2catch {name}' has ended; its last words: {said}")


def _summary(log: Path) -> dict[str, Any]:
    """What the deployment said of itself at its end."""
    for line in reversed(log.read_text(errors="replace").splitlines()):
        if line.startswith('{"summary"'):
            return json.loads(line)["summary"]
    raise DeploymentError(f"the deployment ended without a summary; see {log}.")
