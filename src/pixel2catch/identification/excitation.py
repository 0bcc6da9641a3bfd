"""Draw a trajectory that shows the joints' dynamics and that a robot can follow.

It rests in the start pose, moves smoothly to the middle of the excitation, makes the kinds of motion one by
one, moves back and rests. It is simulated first; joints that violate a limit or a distance move less. The
kinds of motion are offsets from the middle, zero at both ends and within an `Envelope`.
"""

import dataclasses
import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from pixel2catch.checks import Fraction, Seed, Within, require_valid
from pixel2catch.errors import InvalidValueError
from pixel2catch.identification import recording
from pixel2catch.identification.recording import Trajectory
from pixel2catch.identification.rehearsal import Assessment, assess
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

RATE = 125.0  # of the targets [Hz] (ours; every fourth cycle of a UR e-series controller)
STILL = ("start", "pause", "end")  # parts of a trajectory without excitation
PAUSE = 0.4  # rest in the middle after each kind of motion [s] (ours, three time constants of the arm)
APPROACH = 1.5  # shortest time from the start pose to the middle of the excitation [s] (ours)
MIN_MOTION = 12.0  # least time for all kinds of motion [s] (ours, half a second for each turn)
MAX_SECONDS = 600.0  # longest excitation [s] (ours; a fit takes many times as long)
MAX_TRIES = 10  # most tries to draw a trajectory (ours)
SPEED_SHARE = 0.8  # share of the speed limit that commands use at full speed (ours; joints move each other)
NUM_TONES, BAND = 9, (0.25, 5.0)
"""Number and lowest and highest frequency of the sines [Hz]. Source: ours. Damping over stiffness of the
joints corresponds to 1.2 Hz (arm) and 4.8 Hz (hand); the drives' inertia shows above."""

FADE = 0.4  # time in which sines fade in and out [s] (ours)
DWELL = (0.25, 0.65)  # time between a joint's steps [s] (ours, 2 to 5 time constants of the arm)
POLICY_PERIOD = 0.05  # time between two targets like a policy's [s] (ours; servos come nearer than at 30 Hz)
SLOW_SPEED = 0.15  # top speed of slow reversals [rad/s] (ours; dry friction turns around within 0.1 rad/s)
NUM_TURNS = 6  # groups of joints that move in turns: one joint of the arm, and one of each finger
Row = Float64[np.ndarray, " num_joints"]
Offsets = Float64[np.ndarray, "num_times num_joints"]


@dataclass(frozen=True, kw_only=True)
class ExcitationCfg:
    """The trajectory to draw."""

    workcell: WorkcellSpec = UR5E_ALLEGRO  #: work cell of the joints
    robot: str | None = None  #: part that moves; None moves all joints
    seconds: Annotated[float, Within(0.0, MAX_SECONDS, is_open=True)] = 40.0  #: duration, rest included [s]
    seed: Seed = 0  #: seed of everything that is drawn
    speed: Fraction = 1.0  #: factor on speed, acceleration and jumps; 1 is full

    def __post_init__(self) -> None:
        recording.joints_of(self.workcell, self.robot)
        require_valid(self)


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """Limits of the commands of some joints, one entry per joint."""

    joints: tuple[str, ...]  #: their names
    home: Row  #: start pose [rad]
    center: Row  #: middle of the excitation [rad]: near the start pose, with room for `swing` on both sides
    swing: Row  #: farthest from the middle [rad]
    speed: Row  #: largest speed of a command [rad/s]
    acceleration: Row  #: largest acceleration of a smooth command [rad/s²]
    step: Row  #: largest jump of a command [rad]

    @classmethod
    def of(
        cls, joints: Sequence[str], speed: float, shrunk: Mapping[str, float], workcell: WorkcellSpec
    ) -> "Envelope":
        """Return the envelope of some joints; `speed` and `shrunk`, by joint, are factors on their motion."""
        known, groups = recording.specs_of(workcell), recording.groups_of(workcell)
        specs = [known[name] for name in joints]
        ranges = [recording.MOTION_RANGES[groups[name].role] for name in joints]
        share = np.array([shrunk.get(name, 1.0) for name in joints])
        lower, upper, home = np.array([(spec.lower, spec.upper, spec.home) for spec in specs]).T
        margin, swing, acceleration = np.array([(e.margin, e.swing, e.acceleration) for e in ranges]).T
        lower, upper = lower + margin, upper - margin
        swing = share * np.minimum(swing, (upper - lower) / 2)
        pace = speed * share
        return cls(
            joints=tuple(joints),
            home=home,
            center=np.clip(home, lower + swing, upper - swing),
            swing=swing,
            speed=pace * SPEED_SHARE * np.array([spec.velocity_limit for spec in specs]),
            acceleration=pace * acceleration,
            step=pace * np.array([recording.largest_step(spec) for spec in specs]),
        )


Signal = Callable[[Generator, Envelope, int], Offsets]


def multisine(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Return sines of all joints at once, each joint with its own frequencies; all have about one speed."""
    time = np.arange(num_times)[:, None, None] / RATE
    shape = (NUM_TONES, len(envelope.joints))
    frequency = np.geomspace(*BAND, NUM_TONES)[:, None] * rng.uniform(0.9, 1.1, shape)
    phase = rng.uniform(0.0, 2 * np.pi, shape)
    tones = np.sin(2 * np.pi * frequency * time + phase) / frequency
    offsets = _faded(tones.sum(axis=1))
    return offsets * _room(envelope, offsets)


def slow_reversals(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Return two or three slow turns there and back, for dry friction."""
    duration = num_times / RATE
    frequency = rng.integers(2, 4, len(envelope.joints)) / duration
    amplitude = rng.choice((-1.0, 1.0), len(frequency)) * SLOW_SPEED / (2 * np.pi * frequency)
    slow = _faded(amplitude * np.sin(2 * np.pi * frequency * np.arange(num_times)[:, None] / RATE))
    return slow * np.minimum(1.0, _room(envelope, slow))


def steps(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Return jumps of every joint at its own times, which load the drives up to their torque limit."""
    bounds = np.minimum(envelope.swing, envelope.step)
    sizes = np.minimum(2 * envelope.swing, envelope.step)
    columns = [_steps(rng, bound, size, num_times) for bound, size in zip(bounds, sizes, strict=True)]
    return np.stack(columns, axis=-1)


def _steps(rng: Generator, bound: float, size: float, num_times: int) -> Float64[np.ndarray, " num_times"]:
    """Return levels of one joint within ± bound, each jump at most `size` and towards the other side."""
    shortest = round(RATE * DWELL[0])
    dwell = RATE * rng.uniform(*DWELL, num_times // shortest + 1)
    latest = max(1, num_times - 2 * shortest)
    starts = (rng.uniform(1.0, min(shortest, latest)) + np.cumsum(dwell) - dwell[0]).astype(int)
    column, level = np.zeros(num_times), 0.0
    for start in starts[starts <= latest]:
        side = -np.sign(level) or rng.choice((-1.0, 1.0))
        level = float(np.clip(level + side * size * rng.uniform(0.5, 1.0), -bound, bound))
        column[start : num_times - shortest] = level
    return column


def policy_targets(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Return a random walk at 20 Hz with a ramp from target to target, as the environment makes."""
    change = envelope.speed * POLICY_PERIOD
    times = np.arange(num_times) / RATE
    num_changes = int(times[-1] / POLICY_PERIOD)
    targets = np.zeros((num_changes + 1, len(change)))
    for k in range(1, num_changes):
        walked = targets[k - 1] + change * rng.uniform(-1.0, 1.0, len(change))
        bound = np.minimum(envelope.swing, (num_changes - k) * change)
        targets[k] = np.clip(walked, -bound, bound)
    knots = POLICY_PERIOD * np.arange(num_changes + 1)
    return np.stack([np.interp(times, knots, column) for column in targets.T], axis=-1)


def turns(rng: Generator, envelope: Envelope, num_times: int) -> Offsets:
    """Return steps of one group of joints after the other, so that joints hardly move each other."""
    turn, parts = np.arange(len(envelope.joints)) % NUM_TURNS, []
    for k, length in enumerate(np.diff(np.linspace(0, num_times, NUM_TURNS + 1).astype(int))):
        swing, step = np.where(turn == k, (envelope.swing, envelope.step), 0.0)
        parts.append(steps(rng, dataclasses.replace(envelope, swing=swing, step=step), int(length)))
    return np.concatenate(parts)


def approach(envelope: Envelope) -> Offsets:
    """Return the way from the start pose to the middle: a quintic polynomial that starts and ends at rest.

    Its top speed is 15/8 of the mean one, its top acceleration 10/√3 of distance over time squared.
    """
    way = envelope.home - envelope.center
    distance = np.abs(way)
    shortest = np.sqrt(10 / np.sqrt(3) * distance / envelope.acceleration)
    duration = float(np.max((15 / 8 * distance / envelope.speed, shortest), initial=APPROACH))
    share = np.linspace(0.0, 1.0, int(np.ceil(duration * RATE)) + 1)[:, None]
    return way * (1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2))


def _faded(offsets: Offsets) -> Offsets:
    """Return a signal that begins and ends at zero smoothly."""
    time = np.minimum(np.arange(len(offsets)), np.arange(len(offsets))[::-1]) / RATE
    return np.sin(np.pi / 2 * np.minimum(1.0, time / FADE))[:, None] ** 2 * offsets


def _room(envelope: Envelope, offsets: Offsets) -> Row:
    """Return the factor by which each joint's signal reaches swing, speed or acceleration."""
    limits = (envelope.swing, envelope.speed, envelope.acceleration)
    peaks = [np.abs(np.diff(offsets, n, axis=0)).max(axis=0) * RATE**n for n in range(3)]
    return np.min(np.divide(limits, np.maximum(peaks, 1e-12)), axis=0)


SEGMENTS: tuple[tuple[Signal, float], ...] = (
    (multisine, 0.2),
    (steps, 0.3),
    (policy_targets, 0.15),
    (turns, 0.25),
    (slow_reversals, 0.1),
)
"""The kinds of motion in order, with their shares of the time. Source: ours."""


def find_excitation(
    cfg: ExcitationCfg, dynamics: JointDynamics, report: Callable[[str], None]
) -> tuple[Trajectory, Assessment]:
    """Draw a trajectory, and shrink it until a simulated robot follows it; return that robot's motion, too.

    Raises InvalidValueError if even small motion has violations.
    """
    shrunk, reasons = dict[str, float](), ""
    for _ in range(MAX_TRIES):
        trajectory = draw_excitation(cfg, shrunk)
        assessment = assess(trajectory, dynamics)
        if not assessment.violations:
            return trajectory, assessment
        for joint in trajectory.joints:
            factors = [each.remedy for each in assessment.violations if joint in each.joints]
            shrunk[joint] = shrunk.get(joint, 1.0) * min(factors, default=1.0)
        reasons = "; ".join(each.text for each in assessment.violations)
        report(f"trying less motion: {reasons}")
    raise InvalidValueError(f"no safe excitation: {reasons}. Try another --seed or less --speed.")


def draw_excitation(cfg: ExcitationCfg, shrunk: Mapping[str, float]) -> Trajectory:
    """Draw one trajectory without a test in simulation; `shrunk` are factors on the motion, by joint."""
    rng = np.random.default_rng(cfg.seed)
    joints = recording.joints_of(cfg.workcell, cfg.robot)
    envelope = Envelope.of(joints, cfg.speed, shrunk, cfg.workcell)
    parts = _parts(rng, envelope, cfg.seconds)
    edges = np.cumsum([0, *(len(offsets) for _, offsets in parts)]) / RATE
    spans = {name: edges[i : i + 2].tolist() for i, (name, _) in enumerate(parts) if name not in STILL}
    positions = envelope.center + np.concatenate([offsets for _, offsets in parts])
    times, robot = np.arange(len(positions)) / RATE, cfg.robot or cfg.workcell.name
    header = {"robot": robot, "seed": cfg.seed, "speed": cfg.speed, "shrunk": dict(shrunk), "segments": spans}
    header |= {"pixel2catch": importlib.metadata.version("pixel2catch"), "numpy": np.__version__}
    return Trajectory(workcell=cfg.workcell, joints=joints, times=times, positions=positions, header=header)


def _parts(rng: Generator, envelope: Envelope, seconds: float) -> list[tuple[str, Offsets]]:
    there = approach(envelope)
    rest = np.repeat(there[:1], round(recording.REST * RATE) + 1, axis=0)
    pause = np.zeros((round(PAUSE * RATE), len(envelope.joints)))
    start, end = np.concatenate((rest, there, pause)), np.concatenate((pause, there[::-1], rest))
    num_left = round(seconds * RATE) + 1 - len(start) - len(end) - (len(SEGMENTS) - 1) * len(pause)
    if num_left < MIN_MOTION * RATE:
        least = np.ceil(seconds + MIN_MOTION - num_left / RATE)
        raise InvalidValueError(f"seconds is {seconds:g}; at this speed it must be at least {least:g}")
    edges = np.rint(num_left * np.cumsum([0.0, *(share for _, share in SEGMENTS)])).astype(int)
    parts = [("start", start)]
    for (signal, _), num in zip(SEGMENTS, np.diff(edges), strict=True):
        parts += [(signal.__name__, signal(rng, envelope, int(num))), ("pause", pause)]
    return [*parts[:-1], ("end", end)]
