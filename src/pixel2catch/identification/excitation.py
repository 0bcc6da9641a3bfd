"""A trajectory that tells the joints' dynamics and that a robot can be let loose on.

Rest in the start pose, a smooth move to the middle of the excitation, the kinds of motion one by one, a
smooth move back, rest. What is drawn is simulated first; where it comes too near to a limit or an obstacle,
the joints in question move less.
"""

import importlib.metadata
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification.excitation_check import Assessment, assess
from pixel2catch.identification.excitation_limits import Envelope
from pixel2catch.identification.excitation_signals import (
    RATE,
    Offsets,
    Signal,
    approach,
    multisine,
    policy_targets,
    slow_reversals,
    steps,
    turns,
)
from pixel2catch.identification.recording import ROBOTS
from pixel2catch.identification.trajectory import REST, Trajectory
from pixel2catch.robot.joint_dynamics import JointDynamics

SEGMENTS: tuple[tuple[Signal, float], ...] = (
    (multisine, 0.2),
    (steps, 0.3),
    (policy_targets, 0.15),
    (turns, 0.25),
    (slow_reversals, 0.1),
)
"""The kinds of motion in order, with their shares of the time. Source: ours."""

STILL = ("start", "pause", "end")
"""Parts of a trajectory that are no excitation."""

PAUSE = 0.4
"""Rest in the middle after each kind of motion [s] (ours, three time constants of the arm)."""

MIN_MOTION = 12.0
"""Least time for all kinds of motion [s]. Source: ours, half a second for each turn."""

MAX_SECONDS = 600.0
"""Longest excitation [s] (ours; a fit takes as long as all recordings together, many times over)."""

MAX_TRIES = 10
"""Tries until it is given up (ours)."""


@dataclass(frozen=True, kw_only=True)
class ExcitationCfg:
    """What to draw.

    Attributes:
        robot: Whose joints move: a name in `ROBOTS`.
        seconds: Duration, rest included [s].
        seed: Seed of everything that is drawn.
        speed: Factor on speed, acceleration and jumps; 1 is full.
    """

    robot: str = "ur5e_allegro"
    seconds: float = 40.0
    seed: int = 0
    speed: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        if self.robot not in ROBOTS:
            raise UnknownNameError("robot", self.robot, ROBOTS)
        if not 0.0 < self.seconds <= MAX_SECONDS:
            raise InvalidValueError(f"seconds is {self.seconds:g}; it must be up to {MAX_SECONDS:g}")
        if not 0.0 < self.speed <= 1.0:
            raise InvalidValueError(f"speed is {self.speed:g}; it must be above 0 and at most 1")
        if self.seed < 0:
            raise InvalidValueError(f"seed is {self.seed}; it must be 0 or more")


def find_excitation(
    cfg: ExcitationCfg, dynamics: JointDynamics, report: Callable[[str], None]
) -> tuple[Trajectory, Assessment]:
    """Draw a trajectory, and shrink it until a simulated robot follows it without a fault.

    Args:
        cfg: What to draw.
        dynamics: Of the robot's joints.
        report: Gets a line for every try that was too much.

    Returns:
        The trajectory and what the simulated robot did.

    Raises:
        InvalidValueError: If even small motion has faults.
    """
    shrunk: dict[str, float] = {}
    reasons = ""
    for _ in range(MAX_TRIES):
        trajectory = draw_excitation(cfg, shrunk)
        assessment = assess(trajectory, dynamics)
        if not assessment.faults:
            return trajectory, assessment
        for joint in trajectory.joints:
            factors = [fault.remedy for fault in assessment.faults if joint in fault.joints]
            shrunk[joint] = shrunk.get(joint, 1.0) * min(factors, default=1.0)
        reasons = "; ".join(fault.text for fault in assessment.faults)
        report(f"trying less motion, because {reasons}")
    raise InvalidValueError(f"no safe excitation: at last, {reasons}. Try another seed or less speed.")


def draw_excitation(cfg: ExcitationCfg, shrunk: Mapping[str, float]) -> Trajectory:
    """Draw one trajectory; whether a robot can follow it is not known yet.

    Args:
        cfg: What to draw.
        shrunk: Factors on the motion of single joints; 1 where there is none.
    """
    rng = np.random.default_rng(cfg.seed)
    envelope = Envelope.of(ROBOTS[cfg.robot], cfg.speed, shrunk)
    parts = _parts(rng, envelope, cfg.seconds)
    edges = np.cumsum([0, *(len(offsets) for _, offsets in parts)]) / RATE
    spans = {name: edges[i : i + 2].tolist() for i, (name, _) in enumerate(parts) if name not in STILL}
    positions = envelope.center + np.concatenate([offsets for _, offsets in parts])
    return Trajectory(
        joints=envelope.joints,
        times=np.arange(len(positions)) / RATE,
        positions=positions,
        header={
            "robot": cfg.robot,
            "seed": cfg.seed,
            "speed": cfg.speed,
            "shrunk": dict(shrunk),
            "segments": spans,
            "pixel2catch": importlib.metadata.version("pixel2catch"),
            "numpy": np.__version__,
        },
    )


def _parts(rng: Generator, envelope: Envelope, seconds: float) -> list[tuple[str, Offsets]]:
    """All parts in order: their names, and offsets from the middle of the excitation.

    Raises:
        InvalidValueError: If too little time is left for the kinds of motion.
    """
    there = approach(envelope)
    rest = np.repeat(there[:1], round(REST * RATE) + 1, axis=0)
    pause = np.zeros((round(PAUSE * RATE), len(envelope.joints)))
    start, end = np.concatenate((rest, there, pause)), np.concatenate((pause, there[::-1], rest))
    num_left = round(seconds * RATE) + 1 - len(start) - len(end) - (len(SEGMENTS) - 1) * len(pause)
    if num_left < MIN_MOTION * RATE:
        least = seconds + MIN_MOTION - num_left / RATE
        raise InvalidValueError(
            f"seconds is {seconds:g}; at this speed it must be at least {np.ceil(least):g}"
        )
    edges = np.rint(num_left * np.cumsum([0.0, *(share for _, share in SEGMENTS)])).astype(int)
    parts = [("start", start)]
    for (signal, _), num in zip(SEGMENTS, np.diff(edges), strict=True):
        parts += [(signal.__name__, signal(rng, envelope, int(num))), ("pause", pause)]
    return [*parts[:-1], ("end", end)]
