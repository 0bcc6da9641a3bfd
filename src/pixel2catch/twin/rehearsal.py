"""A rehearsal: twin and deployment as processes of their own, an operator, and throws by number."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import RealClock, make_transport
from pixel2catch.twin.realtime import PROFILE
from pixel2catch.twin.trials import Outcome, RehearsalOperator, of_twin, rates, run_trial

START_TIME = 120.0
"""Real time in which both processes must be there [s]: on loaded machines imports are slow. Source: ours."""

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
        operator = RehearsalOperator(node, Profile.load(PROFILE).operator, clock)
        _wait_for_both(operator, (twin, deploy), cfg)
        outcomes = []
        for seed in range(cfg.seed, cfg.seed + cfg.throws):
            outcomes.append(run_trial(operator, seed))
            report(outcomes[-1])
            _require_alive((twin, deploy), cfg.logs)
        truth = operator.truth
    return {
        **rates(outcomes),
        "clock": cfg.clock,
        "seconds": time.perf_counter() - begin,
        "deploy": _summary(cfg.logs / "deploy.txt"),
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
    operator: RehearsalOperator, processes: Sequence[subprocess.Popen[bytes]], cfg: RehearsalCfg
) -> None:
    """Wait until twin and deployment are heard of, and the servo ticks."""

    def are_there() -> bool:
        _require_alive(processes, cfg.logs)
        has_image = operator.console.status.get("verdict") != "no image"
        return bool(operator.truth) and operator.mode == "idle" and has_image

    operator.until(are_there, cfg.clock * START_TIME, "twin and deployment")


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
