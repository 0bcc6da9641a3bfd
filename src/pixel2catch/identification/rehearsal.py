"""Simulate a robot that follows a trajectory: its recording, and the limits and distances that it violates.

For rehearsals with known dynamics, and before a real robot follows a trajectory.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from pixel2catch.identification.checks import DataCheck, check_recording
from pixel2catch.identification.recording import Recording, Trajectory, groups_of, specs_of
from pixel2catch.identification.simulation import (
    FIT_DT,
    RecordedMotion,
    hanging_on,
    is_settled,
    step_commands,
)
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.scene import SceneCfg, build_spec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

STALLED_TURN = 0.04  # length of a turn that stalls [s]. Source: a real UR5 recording, where 5 % did.
STALL = 0.05  # share of a loop's turns that stall. Source: the same.
PERIOD = 0.008  # turn of a loop [s] (ours, a UR e-series controller's fourth cycle)
NOISE = 2e-4  # standard deviation of a measured position [rad]. Source: a UR's encoders.

LIMIT_TOLERANCE = 0.005
"""Tolerated excess of a position limit [rad]. Source: ours; in the start pose two joints are at their limits,
and the motion of others moves them a little."""

HORIZON = 0.1  # largest distance that is measured [m]


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

    Two independent loops send commands and record positions with noise; both stall. Perfect recordings have
    every physics step, without stalls and noise.
    """
    stall, period = (0.0, FIT_DT) if is_perfect else (STALL, PERIOD)
    blanks = []
    for trajectory in trajectories:
        t_cmd = np.append(turns_of_a_loop(rng, trajectory.duration, PERIOD, stall), trajectory.duration)
        start = rng.uniform(0.0, period)
        t_meas = start + turns_of_a_loop(rng, trajectory.duration - start, period, stall)
        blank = Recording(
            workcell=trajectory.workcell,
            joints=trajectory.joints,
            t_cmd=t_cmd,
            q_cmd=trajectory.at(t_cmd),
            t_meas=t_meas,
            q=np.repeat(trajectory.positions[:1], len(t_meas), axis=0),
        )
        blanks.append(blank)
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
    folder.mkdir(parents=True, exist_ok=True)
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


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """A distance to keep, and the smallest one in a motion."""

    name: str  #: the two sides
    margin: float  #: the distance to keep [m]
    is_of_hand: bool  #: whether only joints of a hand change it
    distance: float = np.inf  #: the smallest one [m]; infinite beyond the horizon
    bodies: tuple[str, str] = ("", "")  #: the bodies of the smallest distance
    time: float = 0.0  #: its time [s]

    @property
    def is_kept(self) -> bool:
        """Return whether the distance is large enough."""
        return self.distance >= self.margin

    def sentence(self) -> str:
        """Return the smallest distance as a sentence."""
        if np.isinf(self.distance):
            return f"{self.name}: never closer than {1e3 * HORIZON:.0f} mm"
        return (
            f"{self.name}: {1e3 * self.distance:.1f} mm between {' and '.join(self.bodies)} "
            f"at {self.time:.2f} s; keep {1e3 * self.margin:.0f} mm"
        )


RULES = (
    Clearance(name="robot and table", margin=0.05, is_of_hand=False),
    Clearance(name="arm and robot", margin=0.02, is_of_hand=False),
    Clearance(name="hand and hand", margin=0.005, is_of_hand=True),
)
"""Distances to keep. Source: ours. A laboratory's table, and what stands on it, differ by some centimetres;
the model of the arm consists of capsules; the real covers of the fingers are 5.5 to 9 mm larger than the
model."""


def clearances(
    joints: Sequence[str],
    time: Float64[np.ndarray, " num_times"],
    positions: Float64[np.ndarray, "num_times num_joints"],
    workcell: WorkcellSpec = UR5E_ALLEGRO,
) -> tuple[Clearance, ...]:
    """Return the smallest distances in a motion, one for each of `RULES`, by MuJoCo's collision detection.

    The joints are at some positions [rad] at some times [s]; others hold the start pose.
    """
    spec = build_spec(SceneCfg(workcell=workcell.name))
    for sensor in spec.sensors:
        spec.delete(sensor)
    spec.delete(spec.body("object"))
    model = spec.compile()
    model.geom_gap[:] = HORIZON / 2  # pairs within the horizon count as contacts without force
    data = mujoco.MjData(model)
    data.qpos[:] = [spec.home for spec in workcell.joints]
    columns = [int(model.joint(name).qposadr[0]) for name in joints]
    rules = _rule_of_pairs(model, workcell)
    least = list(RULES)
    for now, row in zip(time, positions, strict=True):
        data.qpos[columns] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        pairs, distances = data.contact.geom, data.contact.dist
        rule_of_contact = rules[pairs[:, 0], pairs[:, 1]]
        for i, known in enumerate(least):
            contacts = np.flatnonzero(rule_of_contact == i)
            nearest = contacts[np.argmin(distances[contacts])] if len(contacts) else None
            if nearest is not None and distances[nearest] < known.distance:
                bodies = tuple(model.body(model.geom_bodyid[geom]).name for geom in pairs[nearest])
                found = {"distance": float(distances[nearest]), "bodies": bodies, "time": float(now)}
                least[i] = dataclasses.replace(known, **found)
    return tuple(least)


def _rule_of_pairs(model: mujoco.MjModel, workcell: WorkcellSpec) -> np.ndarray:
    """Return the index in `RULES` for two geoms, shape (geoms, geoms); -1 for those that touch on purpose.

    The root of a robot and the link that turns on it stand on the table; a hand is all that hangs on a palm.
    """
    body, parents = model.geom_bodyid, model.body_parentid
    roots = [model.body(each.prefix + each.robot.root).id for each in workcell.robots]
    is_standing = np.isin(body, roots) | np.isin(parents[body], roots)
    is_table = body == model.body("table").id
    rules = np.ones((len(body), len(body)), dtype=int)
    for palm in workcell.palms:
        is_hand = hanging_on(parents)[model.body(palm.spec.body).id][body]
        rules[is_hand[:, None] & is_hand] = 2
    rules[is_table[:, None] | is_table] = 0
    rules[(is_table[:, None] & is_standing) | (is_standing[:, None] & is_table)] = -1
    return rules


@dataclass(frozen=True, kw_only=True)
class Violation:
    """A limit or a distance that a motion violates."""

    text: str  #: the violation as a sentence
    joints: tuple[str, ...]  #: joints whose motion should shrink
    remedy: float = 0.85  #: factor on their motion. Default: ours.


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
    """Simulate a trajectory and check its limits and distances.

    The motion is simulated as in a fit, without contacts; then the distances of every step are measured in
    the whole scene. Without violations there would be no contacts.
    """
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
