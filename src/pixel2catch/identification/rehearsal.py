"""Simulate a robot that follows a trajectory: its recording, and the limits and distances that it violates.

For rehearsals with known dynamics, and before a real robot follows a trajectory.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from pixel2catch.files import held_folder
from pixel2catch.identification.checks import DataCheck, check_recording
from pixel2catch.identification.recording import Recording, Trajectory, groups_of, specs_of
from pixel2catch.identification.simulation import FIT_DT, RecordedMotion, is_settled, step_commands
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.distances import RULES, Clearance, Distances

STALLED_TURN = 0.04  # length of a turn that stalls [s]. Source: a real UR5 recording, where 5 % did.
STALL = 0.05  # share of a loop's turns that stall. Source: the same.
PERIOD = 0.008  # turn of a loop [s] (ours, a UR e-series controller's fourth cycle)
NOISE = 2e-4  # standard deviation of a measured position [rad]. Source: a UR's encoders.

LIMIT_TOLERANCE = 0.005  # excess of a position limit [rad] (ours; in the start pose two joints are at theirs)


def turns_of_a_loop(
    rng: Generator, seconds: float, period: float, stall: float
) -> Float64[np.ndarray, " num_turns"]:
    """Return when the turns of a loop begin [s]: the first at 0, all before `seconds`; a share is late."""
    lengths = np.where(rng.random(int(np.ceil(seconds / period))) < stall, STALLED_TURN, period)
    times = np.concatenate(([0.0], np.cumsum(lengths)[:-1]))
    return times[times < seconds]


def simulated_recordings(
    trajectories: Sequence[Trajectory], truth: JointDynamics, rng: Generator, *, is_perfect: bool = False
) -> list[Recording]:
    """Return recordings of a simulated robot that follows trajectories, each from its start pose.

    Two loops send commands and record noisy positions; both stall. Perfect ones have every physics step.
    """
    stall, period = (0.0, FIT_DT) if is_perfect else (STALL, PERIOD)
    blanks = []
    for trajectory in trajectories:
        t_cmd = np.append(turns_of_a_loop(rng, trajectory.duration, PERIOD, stall), trajectory.duration)
        start = rng.uniform(0.0, period)
        robot = {"workcell": trajectory.workcell, "joints": trajectory.joints}
        t_meas = start + turns_of_a_loop(rng, trajectory.duration - start, period, stall)
        q = np.repeat(trajectory.positions[:1], len(t_meas), axis=0)
        blanks.append(Recording(**robot, t_cmd=t_cmd, q_cmd=trajectory.at(t_cmd), t_meas=t_meas, q=q))
    motion = RecordedMotion(blanks)
    (simulated,) = motion.simulate([truth])
    recordings = []
    for blank, path in zip(blanks, motion.split(simulated), strict=True):
        q = np.concatenate((blank.q[~is_settled(blank)], path))
        noise = 0.0 if is_perfect else NOISE * rng.standard_normal(q.shape)
        recordings.append(dataclasses.replace(blank, q=q + noise))
    return recordings


def rehearse(folder: Path, trajectories: Sequence[Trajectory], truth: JointDynamics, seed: int) -> None:
    """Write recordings of a simulated robot, recording-1.npz and so on, and its dynamics file truth.json."""
    recordings = simulated_recordings(trajectories, truth, np.random.default_rng((seed, 1)))
    with held_folder(folder):
        for number, recording in enumerate(recordings, start=1):
            recording.save(folder / f"recording-{number}.npz")
        exact_file(truth, trajectories[0].workcell).save(folder / "truth.json")


def exact_file(truth: JointDynamics, workcell: WorkcellSpec) -> DynamicsFile:
    """Return a dynamics file whose gains are not randomised."""
    one = ((1.0, 1.0),)
    return DynamicsFile(
        dynamics=truth, gains=GainRanges(stiffness_scale=one, damping_scale=one), workcell=workcell
    )


def unlike_nominal(rng: Generator, nominal: JointDynamics, latency: float = 0.012) -> JointDynamics:
    """Draw dynamics up to 40 % off the nominal ones in every parameter, with a latency [s]."""
    names = ("stiffness", "damping", "frictionloss", "armature")
    factors = {name: getattr(nominal, name) * rng.uniform(0.7, 1.4, len(nominal.joints)) for name in names}
    return nominal.with_values(**factors, latency=latency)


def clearances(
    joints: Sequence[str],
    time: Float64[np.ndarray, " num_times"],
    positions: Float64[np.ndarray, "num_times num_joints"],
    workcell: WorkcellSpec,
) -> tuple[Clearance, ...]:
    """Return the smallest distance in a motion for each of `RULES`; other joints are in the start pose."""
    distances, least = Distances(workcell), list(RULES)
    joint_pos = np.array([joint.home for joint in workcell.joints])
    columns = [workcell.joint_names.index(name) for name in joints]
    for now, row in zip(time, positions, strict=True):
        joint_pos[columns] = row
        for i, found in enumerate(distances.at(joint_pos)):
            if found.distance < least[i].distance:
                least[i] = dataclasses.replace(found, time=float(now))
    return tuple(least)


@dataclass(frozen=True, kw_only=True)
class Violation:
    """A limit or a distance that a motion violates."""

    text: str  #: the violation as a sentence
    joints: tuple[str, ...]  #: joints whose amplitude is reduced to avoid it
    remedy: float = 0.85  #: factor on their amplitude. Default: ours.


@dataclass(frozen=True, kw_only=True, eq=False)
class Assessment:
    """The motion of a simulated robot that follows a trajectory, and what is wrong with it."""

    recording: Recording  #: the motion at every physics step
    clearances: tuple[Clearance, ...]  #: distances to the table and of the robot's parts
    checks: tuple[DataCheck, ...]  #: whether each joint is excited enough to show its dynamics
    violations: tuple[Violation, ...]
    #: Share of the time in which a servo requests more torque than its drive has, by joint; without zeros.
    at_torque_limit: dict[str, float] = field(default_factory=dict)


def assess(trajectory: Trajectory, dynamics: JointDynamics) -> Assessment:
    """Simulate a trajectory as in a fit, without contacts, and check limits and distances of every step."""
    (recording,) = simulated_recordings([trajectory], dynamics, np.random.default_rng(0), is_perfect=True)
    near = clearances(recording.joints, recording.t_meas, recording.q, recording.workcell)
    return Assessment(
        recording=recording,
        clearances=near,
        checks=tuple(check for check in check_recording(recording) if check.name == "excitation"),
        violations=tuple(_violations(recording, near)),
        at_torque_limit=_at_torque_limit(recording, dynamics),
    )


def _at_torque_limit(recording: Recording, dynamics: JointDynamics) -> dict[str, float]:
    """Return `Assessment.at_torque_limit` of a perfect recording; filters of commands are left out."""
    times, specs = recording.t_meas, specs_of(recording.workcell)
    targets = step_commands(recording.t_cmd, recording.q_cmd, times, dynamics.latency)[:, 0]
    speed = np.diff(recording.q, axis=0) / np.diff(times)[:, None]
    torque = dynamics.stiffness * (targets - recording.q[1:]) - dynamics.damping * speed
    limits = np.array([specs[name].effort_limit for name in recording.joints])
    shares = dict(zip(recording.joints, (np.abs(torque) > limits).mean(axis=0).tolist(), strict=True))
    return {name: share for name, share in shares.items() if share > 0.0}


def _violations(recording: Recording, near: Sequence[Clearance]) -> Iterator[Violation]:
    groups, speed = groups_of(recording.workcell), np.diff(recording.q, axis=0) / FIT_DT
    for column, joint in enumerate(recording.joints):
        spec, q = specs_of(recording.workcell)[joint], recording.q[:, column]
        excess, top = max(spec.lower - q.min(), q.max() - spec.upper), np.abs(speed[:, column]).max()
        if excess > LIMIT_TOLERANCE:
            yield Violation(text=f"{joint} moves {excess:.3f} rad beyond its limits", joints=(joint,))
        if top > spec.velocity_limit:
            text = f"{joint} reaches {top:.2f} rad/s of {spec.velocity_limit:.2f}"
            yield Violation(text=text, joints=(joint,), remedy=0.95 * spec.velocity_limit / top)
    for clearance in near:
        if not clearance.is_kept:
            role = "hand" if clearance.is_of_hand else "arm"
            moved = tuple(joint for joint in recording.joints if groups[joint].role == role)
            yield Violation(text=clearance.sentence(), joints=moved or recording.joints)
