"""A rehearsal: twin and deployment as processes of their own, an operator, and throws by number."""

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

from pixel2catch.deployment.clock import RealClock
from pixel2catch.deployment.network import make_transport
from pixel2catch.deployment.profile import Profile
from pixel2catch.errors import DeploymentError
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.twin.operator import Operator
from pixel2catch.twin.running import PROFILE

START_TIME = 120.0
"""Real time in which both processes must be there [s]: on loaded machines imports are slow. Source: ours."""

STEP_TIME = 10.0
"""Time in which each step of a throw must be done [s]. Source: ours."""

END_TIME = 30.0
"""Real time in which a process must have ended [s]."""


@dataclass(frozen=True, kw_only=True)
class RehearsalCfg:
    """What is rehearsed.

    Attributes:
        throws: How many throws.
        seed: Of the first throw; the next has the next.
        clock: Seconds of twin and deployment in a real second.
        domain: DDS domain.
        twin: Further arguments of `pixel2catch twin`.
        deploy: Further arguments of `pixel2catch deploy`.
        logs: Folder for what both processes print.
    """

    throws: int
    seed: int
    clock: float
    domain: int
    twin: tuple[str, ...]
    deploy: tuple[str, ...]
    logs: Path


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


def rehearse(cfg: RehearsalCfg, report: Callable[[Outcome], None]) -> dict[str, Any]:
    """Throw, and count.

    Args:
        cfg: What is rehearsed.
        report: Called after every throw.

    Returns:
        The report, for programs.

    Raises:
        DeploymentError: A process did not start, or ended early.
    """
    os.environ["ROS_DOMAIN_ID"] = str(cfg.domain)
    clock, begin = RealClock(cfg.clock), time.perf_counter()
    common = ("--clock", f"{cfg.clock:g}")
    with ExitStack() as stack:
        twin = stack.enter_context(_process(cfg.logs, "twin", *common, "--seed", str(cfg.seed), *cfg.twin))
        deploy = stack.enter_context(
            _process(cfg.logs, "deploy", *common, "--loopback", "--json", *cfg.deploy)
        )
        node = stack.enter_context(make_transport("dds", "pixel2catch_operator", True, clock))
        operator = Operator(node, Profile.load(PROFILE).operator, clock)
        _wait_for_both(operator, (twin, deploy), cfg)
        outcomes = []
        for seed in range(cfg.seed, cfg.seed + cfg.throws):
            outcomes.append(throw(operator, seed))
            report(outcomes[-1])
            _require_alive((twin, deploy), cfg.logs)
        truth = operator.truth
    return {
        **_rates(outcomes),
        "clock": cfg.clock,
        "seconds": time.perf_counter() - begin,
        "deploy": _summary(cfg.logs / "deploy.txt"),
        "twin": {
            name: truth.get(name)
            for name in ("joint_speed", "halts", "ignored", "late_images", "lost_images")
        },
        "throws": [asdict(outcome) for outcome in outcomes],
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
    operator: Operator, processes: Sequence[subprocess.Popen[bytes]], cfg: RehearsalCfg
) -> None:
    """Wait until twin and deployment are heard of, and the servo ticks."""

    def are_there() -> bool:
        _require_alive(processes, cfg.logs)
        return bool(operator.truth) and operator.mode == "idle" and operator.status["verdict"] != "no image"

    operator.until(are_there, cfg.clock * START_TIME, "twin and deployment")


def _require_alive(processes: Sequence[subprocess.Popen[bytes]], logs: Path) -> None:
    for process in processes:
        if process.poll() is not None:
            name = process.args[3]  # type: ignore[index]
            lines = (logs / f"{name}.txt").read_text(errors="replace").strip().splitlines()
            said = lines[-1] if lines else "nothing"
            raise DeploymentError(f"'pixel2catch {name}' has ended; its last words: {said}")


def throw(operator: Operator, seed: int) -> Outcome:
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


def _prepare(operator: Operator, seed: int) -> None:
    """Robot at its start and armed, the object held out and pointed at, the policy in its run."""
    operator.ask_twin(do="prepare", seed=seed)
    operator.until(lambda: operator.phase == "empty", STEP_TIME, "the empty room")
    operator.until(lambda: operator.phase == "held" and operator.truth["box"], STEP_TIME, "the object")
    operator.until(lambda: operator.mode == "idle", STEP_TIME, "an idle servo")
    operator.arm()
    operator.until(lambda: operator.mode == "armed", STEP_TIME, "an armed servo")
    operator.point(operator.truth["box"])
    operator.until(lambda: operator.mode == "run", STEP_TIME, "the policy's run")


def _stop(operator: Operator) -> None:
    """Stop, unless that has happened; that this one comes from the operator is known."""
    if operator.mode in ("armed", "ramp", "run"):
        operator.stop()
        operator.until(lambda: operator.mode not in ("armed", "ramp", "run"), STEP_TIME, "the stop")


def _rates(outcomes: list[Outcome]) -> dict[str, Any]:
    """Tracking and success rate with their intervals, and all stops that nobody asked for."""
    num = len(outcomes)
    rates: dict[str, Any] = {"num_throws": num}
    for name, caught in (
        ("tracking_rate", [outcome.is_tracked for outcome in outcomes]),
        ("success_rate", [outcome.is_success for outcome in outcomes]),
    ):
        rates[name] = sum(caught) / num
        rates[f"{name}_interval"] = wilson_interval(sum(caught), num)
    rates["stops"] = dict(Counter(stop for outcome in outcomes for stop in outcome.stops))
    rates["problems"] = sum(bool(outcome.problem) for outcome in outcomes)
    return rates


def _summary(log: Path) -> dict[str, Any]:
    """What the deployment said of itself at its end."""
    for line in reversed(log.read_text(errors="replace").splitlines()):
        if line.startswith('{"summary"'):
            return json.loads(line)["summary"]
    raise DeploymentError(f"the deployment ended without a summary; see {log}.")
