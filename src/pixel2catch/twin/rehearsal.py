"""A rehearsal: an operator, numbered throws and their report; and twin and deployment as processes.

Both kinds of rehearsal use `run_throws`. `rehearse` adds processes and the network, `stepped` simulated time.
"""

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pixel2catch.deployment.operator import DEPTH, OperatorConsole, newest
from pixel2catch.errors import DeploymentError
from pixel2catch.evaluation.metrics import rate
from pixel2catch.ros2 import messages
from pixel2catch.ros2.profile import PROFILES, OperatorTopics, Profile
from pixel2catch.ros2.transport import LOOPBACK, Clock, RealClock, Transport, make_transport
from pixel2catch.servo.limits import STOP_TIME, ServoLimits
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.lab_node import COMMAND, STATE

POLL = 0.005  #: Time between two polls of the network [s]. Source: ours.
CYCLE_TIME = 120.0  #: Largest time of the motions after a throw [s]. Source: ours.
STEP_TIME = 10.0  #: Largest time of each step of a throw [s]. Source: ours.
START_TIME = 600.0  #: Largest real time until both processes answer [s]; machines may be busy. Source: ours.
END_TIME = 120.0  #: Largest real time until a process has ended [s].
DOMAIN = "77"  #: DDS domain of a rehearsal where ROS_DOMAIN_ID is not set. Source: ours.

MOVING = ("armed", "ramp", "run")  #: Modes of the servo that follow a policy, or will.
STATUS, TRUTH = ("mode", "stopped_by", "found", "refused", "message"), ("phase", "throw", "halted", "refused")
"""Entries of the states of deployment and twin that an error shows."""
TWIN_SUMMARY = ("joint_speed", "halts", "ignored", "late_images", "lost_images")  #: Those in a report.


class RehearsalOperator(OperatorConsole):
    """An operator of twin and deployment, over the network."""

    def __init__(self, transport: Transport, topics: OperatorTopics, clock: Clock) -> None:
        super().__init__(transport, topics, clock)
        self._request = transport.publisher(COMMAND)
        self._states = transport.subscription(STATE, DEPTH)
        self.truth: dict[str, Any] = {}  #: Newest state of the twin.
        self.stops: list[str] = []  #: Reasons of the stops that the deployment reported, newest last.

    @property
    def phase(self) -> str:
        """The twin's `Phase` of the throw; empty before its first state."""
        return self.truth.get("phase", "")

    def request(self, **request: Any) -> None:
        self._request.publish(messages.text(json.dumps(request)))

    def watch(self) -> None:
        """Take what arrived, and repeat that the switch is held, if it is."""
        self.truth = newest(self._states.take(), self.truth)
        before = self.mode
        super().watch()
        if self.mode == "stopped" and before != "stopped":
            self.stops.append(", ".join(self.status["stopped_by"]))

    def wait_until(self, condition: Callable[[], bool], what: str, seconds: float = STEP_TIME) -> None:
        """Watch until a condition holds, at most so long [s], else raise an error that names it."""
        end = self._clock.now() + seconds
        while not condition():
            if self._clock.now() > end:
                status = json.dumps({name: self.status.get(name) for name in STATUS})
                truth = json.dumps({name: self.truth.get(name) for name in TRUTH})
                late = f"{what} did not come within {seconds:g} s"
                raise DeploymentError(f"{late}: deployment {status}, twin {truth}")
            self.watch()
            self._clock.sleep_until(self._clock.now() + POLL)

    def wait(self, seconds: float) -> None:
        end = self._clock.now() + seconds
        self.wait_until(lambda: self._clock.now() >= end, "the end of a wait", seconds + POLL)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a throw."""

    seed: int  #: Seed of the throw.
    object: str | None  #: Object that was thrown; none if it was not thrown.
    is_tracked: bool  #: Whether the palm reached the object, as the tracking rate counts it.
    is_success: bool  #: Whether it was caught.
    stops: list[str]  #: Reasons for which the robot stopped without a request.
    problem: str  #: Why it could not be thrown; empty if it was.


def run_trial(
    operator: RehearsalOperator, seed: int, held: float = 0.0, *, is_cycle: bool = False
) -> Outcome:
    """Run a throw, of an object held so long before [s]; stop the robot, or in a cycle wait for the next."""
    num_stops, problem, thrown = len(operator.stops), "", operator.truth.get("throw", 0)
    try:
        (_start_in_cycle if is_cycle else _start_policy)(operator, seed)
        operator.wait(held)
        operator.request(do="throw")
        operator.wait_until(lambda: operator.truth["throw"] > thrown, "the throw")
        operator.wait_until(lambda: operator.phase == "over", "the end of the throw")
        if is_cycle:
            operator.wait_until(lambda: _waits(operator), "the return to the start pose", CYCLE_TIME)
    except DeploymentError as error:
        problem = str(error)
    truth, stops = operator.truth, operator.stops[num_stops:]
    if not is_cycle or stops or problem:
        _stop_robot(operator)
    result: dict[str, Any] = {"object": None, "is_tracked": False, "is_success": False}
    if truth.get("throw", 0) > thrown:
        result = {name: truth[name] for name in result}
    return Outcome(seed=seed, stops=stops, problem=problem, **result)


def _start_policy(operator: RehearsalOperator, seed: int) -> None:
    _prepare(operator, do="prepare", seed=seed)
    operator.wait_until(lambda: operator.mode == "idle", "an idle servo")
    _arm(operator)
    operator.wait_until(lambda: operator.mode == "armed", "an armed servo")
    operator.point(operator.truth["box"])
    operator.wait_until(lambda: operator.mode == "run", "the policy's run")


def _start_in_cycle(operator: RehearsalOperator, seed: int) -> None:
    if operator.mode not in MOVING:
        _arm(operator)
    operator.wait_until(lambda: operator.mode == "run" and _waits(operator), "the start pose", CYCLE_TIME)
    _prepare(operator, do="next", seed=seed)
    operator.point(operator.truth["box"])
    operator.wait_until(lambda: operator.status.get("cycle") == "throw", "the policy's run")
    operator.wait(ServoLimits.ramp_time)


def _prepare(operator: RehearsalOperator, **request: Any) -> None:
    operator.request(**request)
    operator.wait_until(lambda: operator.phase == "empty", "the empty room")
    operator.wait_until(lambda: operator.phase == "held", "the object")
    if not operator.truth["box"]:
        raise DeploymentError("the camera does not see the object before the throw: place it elsewhere")


def _arm(operator: RehearsalOperator) -> None:
    operator.holds = True
    operator.wait_until(lambda: "dead man" not in operator.status.get("found", ["dead man"]), "a held switch")
    operator.arm()


def _waits(operator: RehearsalOperator) -> bool:
    return operator.status.get("cycle") == "wait"


def _stop_robot(operator: RehearsalOperator) -> None:
    if operator.mode in MOVING:
        operator.stop()
        operator.wait_until(lambda: operator.mode not in MOVING, "the stop")
    operator.holds = False
    operator.wait(STOP_TIME)


OnThrow = Callable[[Outcome], None]  #: Called after every throw.


def run_throws(cfg: RehearsalCfg, operator: RehearsalOperator, on_throw: OnThrow) -> dict[str, Any]:
    """Run all throws; return rates with their intervals, stops without a request, and every outcome."""
    outcomes, is_cycle = list[Outcome](), cfg.after_catch is not None
    for seed in range(cfg.seed, cfg.seed + cfg.throws):
        outcomes.append(run_trial(operator, seed, cfg.held_seconds, is_cycle=is_cycle))
        on_throw(outcomes[-1])
    report = {"num_throws": len(outcomes)}
    for name, flag in (("tracking_rate", "is_tracked"), ("success_rate", "is_success")):
        report |= rate(name, sum(getattr(outcome, flag) for outcome in outcomes), len(outcomes))
    return {
        **report,
        "stops": dict(Counter(stop for outcome in outcomes for stop in outcome.stops)),
        "problems": sum(bool(outcome.problem) for outcome in outcomes),
        "throws": [asdict(outcome) for outcome in outcomes],
        "twin": {name: operator.truth.get(name) for name in TWIN_SUMMARY},
    }


def rehearse(
    cfg: RehearsalCfg, policy: str | None, profile: Profile, logs: Path, on_throw: OnThrow
) -> dict[str, Any]:
    """Run throws with twin and deployment, two commands that write into a folder of logs; return the report.

    Raises DeploymentError if the profile is not shipped, or a process did not start, or ended early.
    """
    if not (PROFILES / f"{profile.name}.yaml").exists():
        raise DeploymentError(f"no profile is shipped for '{profile.workcell}': rehearse it with --lockstep.")
    os.environ.setdefault("ROS_DOMAIN_ID", DOMAIN)
    clock, begin = RealClock(cfg.clock), time.perf_counter()
    both = {"clock": cfg.clock, "camera": cfg.task.camera}
    twin = _options(**both, seed=cfg.seed, policy=policy, dynamics=cfg.task.dynamics)
    deploy = _options(**both, profile=profile.name, after_catch=cfg.after_catch, record=cfg.record)
    with ExitStack() as stack:
        processes = [
            stack.enter_context(running_command(logs, "twin", *twin, "--objects", *cfg.task.objects)),
            stack.enter_context(running_command(logs, "deploy", *filter(None, [policy]), "--json", *deploy)),
        ]
        node = stack.enter_context(make_transport("pixel2catch_operator", LOOPBACK, clock))
        operator = RehearsalOperator(node, profile.operator, clock)

        def is_ready() -> bool:
            _require_running(processes, logs)
            has_image = operator.status.get("verdict") != "no image"
            return bool(operator.truth) and operator.mode == "idle" and has_image

        def after_throw(outcome: Outcome) -> None:
            on_throw(outcome)
            _require_running(processes, logs)

        operator.wait_until(is_ready, "twin and deployment", cfg.clock * START_TIME)
        report = run_throws(cfg, operator, after_throw)
    seconds = time.perf_counter() - begin
    return report | {"clock": cfg.clock, "seconds": seconds, "deploy": printed_summary(logs / "deploy.txt")}


def _options(**values: Any) -> list[str]:
    given = {f"--{name.replace('_', '-')}": str(value) for name, value in values.items() if value is not None}
    return [word for pair in given.items() for word in pair]


@contextmanager
def running_command(logs: Path, command: str, *args: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command as a process that ends with the context; `COMMAND.txt` gets what it prints."""
    words = [sys.executable, "-m", "pixel2catch", command, *args]
    with (
        open(logs / f"{command}.txt", "wb") as file,
        subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT) as process,
    ):
        try:
            yield process
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_TIME)
            process.kill()


def _require_running(processes: Sequence[subprocess.Popen[bytes]], logs: Path) -> None:
    for process in processes:
        if process.poll() is not None:
            name = process.args[3]  # type: ignore[index]
            last = ["nothing", *(logs / f"{name}.txt").read_text(errors="replace").strip().splitlines()][-1]
            raise DeploymentError(f"'pixel2catch {name}' has ended; its last line: {last}")


def printed_summary(log: Path) -> dict[str, Any]:
    """Return the summary that `deploy --json` printed into a log; raise DeploymentError without one."""
    for line in reversed(log.read_text(errors="replace").splitlines()):
        if line.startswith('{"summary"'):
            return json.loads(line)["summary"]
    raise DeploymentError(f"the deployment ended without a summary; see {log}.")
