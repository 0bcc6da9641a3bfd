"""A simulated robot that follows trajectories: what it would have recorded, and what it must not do.

For rehearsals, where the truth must be known, and before a real robot is let loose on a trajectory.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from pixel2catch.checks import Above, Share, Within, require_valid
from pixel2catch.identification.checks import Check, check_recording
from pixel2catch.identification.joints import groups_of, hanging_on, recorded_model, specs_of, watched_model
from pixel2catch.identification.recording import Recording, Trajectory
from pixel2catch.identification.simulation import FIT_DT, RecordedMotion, is_settled
from pixel2catch.mdp.dynamics_file import DynamicsFile, GainRanges
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

STALLED_TURN = 0.04  # length of a turn that stalls [s]. Source: a real UR5 recording, where 5 % did.
MIN_PHYSICS_HZ = 120.0  # fewest physics steps in a second. Source: paper, the rate of a training.
Turn = Annotated[float, Above(0.0, STALLED_TURN)]  # length of a turn of a loop [s]

LIMIT_TOLERANCE = 0.005
"""Excess of a position limit that counts as none [rad]. Source: ours; in the start pose two joints stand at
their limits, and the pull of others moves them a little."""

HORIZON = 0.1  # distance up to which the robot is watched [m]


@dataclass(frozen=True, kw_only=True)
class RecorderCfg:
    """How motion is commanded and recorded: two loops that know nothing of each other."""

    #: standard deviation of a measured position [rad]. Default: a UR's encoders.
    noise: Annotated[float, Within(0.0, 1.0)] = 2e-4
    stall: Share = 0.05  #: share of each loop's turns that take 40 ms
    send_period: Turn = 0.008  #: turn of the loop that sends targets [s]
    read_period: Turn = 0.008  #: turn of the loop that reads positions [s]
    #: by how much the clock of the measurements is ahead of that of the commands [s]. Positions cannot
    #: tell it from latency.
    clock_offset: float = 0.0
    #: physics steps in a second; a fit with as many finds the truth best
    physics_hz: Annotated[float, Within(MIN_PHYSICS_HZ)] = 1.0 / FIT_DT

    def __post_init__(self) -> None:
        """Refuse what no recorder does."""
        require_valid(self)


PERFECT = RecorderCfg(noise=0.0, stall=0.0, read_period=FIT_DT)  # measures every physics step, without noise


def turns_of_a_loop(
    rng: Generator, seconds: float, period: float, stall: float
) -> Float64[np.ndarray, " num_turns"]:
    """When the turns of a loop begin [s]: the first at 0, all before `seconds`; some are late."""
    lengths = np.where(rng.random(int(np.ceil(seconds / period))) < stall, STALLED_TURN, period)
    times = np.concatenate(([0.0], np.cumsum(lengths)[:-1]))
    return times[times < seconds]


def simulated_recordings(
    trajectories: Sequence[Trajectory], truth: JointDynamics, cfg: RecorderCfg, rng: Generator
) -> list[Recording]:
    """What a robot with these dynamics would have recorded of trajectories, each from its start pose."""
    blanks = [_blank(trajectory, cfg, rng) for trajectory in trajectories]
    motion = RecordedMotion(blanks, 1.0 / cfg.physics_hz)
    (simulated,) = motion.simulate([truth])
    recordings = []
    for blank, path in zip(blanks, motion.split(simulated), strict=True):
        q = np.concatenate((blank.q[~is_settled(blank)], path))
        noise = cfg.noise * rng.standard_normal(q.shape)
        recordings.append(dataclasses.replace(blank, q=q + noise, t_meas=blank.t_meas + cfg.clock_offset))
    return recordings


def _blank(trajectory: Trajectory, cfg: RecorderCfg, rng: Generator) -> Recording:
    """Commands and times of a recording, with the positions of the start pose."""
    t_cmd = turns_of_a_loop(rng, trajectory.duration, cfg.send_period, cfg.stall)
    t_cmd = np.append(t_cmd, trajectory.duration)
    start = rng.uniform(0.0, cfg.read_period)
    t_meas = start + turns_of_a_loop(rng, trajectory.duration - start, cfg.read_period, cfg.stall)
    return Recording(
        workcell=trajectory.workcell,
        joints=trajectory.joints,
        t_cmd=t_cmd,
        q_cmd=trajectory.at(t_cmd),
        t_meas=t_meas,
        q=np.repeat(trajectory.positions[:1], len(t_meas), axis=0),
    )


def rehearse(
    folder: Path, trajectories: Sequence[Trajectory], truth: JointDynamics, cfg: RecorderCfg, seed: int
) -> None:
    """Write what a robot would have recorded, recording-1.npz and so on, and truth.json."""
    recordings = simulated_recordings(trajectories, truth, cfg, np.random.default_rng((seed, 1)))
    folder.mkdir(parents=True, exist_ok=True)
    for number, recording in enumerate(recordings, start=1):
        recording.save(folder / f"recording-{number}.npz")
    exact_file(truth, trajectories[0].workcell).save(folder / "truth.json")


def exact_file(truth: JointDynamics, workcell: WorkcellSpec) -> DynamicsFile:
    """The dynamics file of a robot that is known exactly: whatever is simulated with it is that robot."""
    one = ((1.0, 1.0),)
    return DynamicsFile(
        dynamics=truth, gains=GainRanges(stiffness_scale=one, damping_scale=one), workcell=workcell
    )


def unlike_nominal(rng: Generator, nominal: JointDynamics, latency: float = 0.012) -> JointDynamics:
    """Dynamics up to 40 % off the nominal ones in every parameter, and with a latency [s]."""
    names = ("stiffness", "damping", "frictionloss", "armature")
    factors = {name: getattr(nominal, name) * rng.uniform(0.7, 1.4, len(nominal.joints)) for name in names}
    return nominal.with_values(**factors, latency=latency)


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """A distance to keep, and the least there was."""

    name: str  #: between what
    margin: float  #: the distance to keep [m]
    is_of_hand: bool  #: whether only joints of what the arm carries change it
    distance: float = np.inf  #: the least there was [m]; infinite beyond the horizon
    bodies: tuple[str, str] = ("", "")  #: between which bodies it was
    time: float = 0.0  #: when it was [s]

    @property
    def is_kept(self) -> bool:
        """Whether the distance is large enough."""
        return self.distance >= self.margin

    def sentence(self) -> str:
        """What was found, in words."""
        if np.isinf(self.distance):
            return f"{self.name}: never nearer than {1e3 * HORIZON:.0f} mm"
        return (
            f"{self.name}: {1e3 * self.distance:.1f} mm between {' and '.join(self.bodies)} "
            f"at {self.time:.2f} s; {1e3 * self.margin:.0f} mm are to be kept"
        )


RULES = (
    Clearance(name="robot and table", margin=0.05, is_of_hand=False),
    Clearance(name="arm and robot", margin=0.02, is_of_hand=False),
    Clearance(name="hand and hand", margin=0.005, is_of_hand=True),
)
"""What is kept apart. Source: ours. A lab's table, and what stands on it, differ by some centimetres; our arm
is made of capsules; the maker's covers of the fingers run 5.5 to 9 mm beyond the boxes of his description,
which are ours, too."""


def clearances(
    joints: Sequence[str],
    time: Float64[np.ndarray, " num_times"],
    positions: Float64[np.ndarray, "num_times num_joints"],
    workcell: WorkcellSpec = UR5E_ALLEGRO,
) -> tuple[Clearance, ...]:
    """The least distances over a motion, one for each of `RULES`, by MuJoCo's own collision detection.

    The joints are at some positions [rad] at some times [s]; others hold the start pose.
    """
    model = watched_model(workcell, HORIZON)
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
    """Which of `RULES` holds for two geoms, shape (geoms, geoms); -1 for those that stand on each other.

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
class Fault:
    """Something that a robot must not do."""

    text: str  #: what it is, in words
    joints: tuple[str, ...]  #: whose motion should shrink
    remedy: float = 0.85  #: by which factor. Default: ours.


@dataclass(frozen=True, kw_only=True, eq=False)
class Assessment:
    """What a trajectory makes a simulated robot do."""

    recording: Recording  #: the motion at every physics step
    speed: Float64[np.ndarray, " num_joints"]  #: top speed of each joint [rad/s]
    torque_share: Float64[np.ndarray, " num_joints"]  #: top torque of each servo, as a share of its limit
    clearances: tuple[Clearance, ...]  #: distances to the table and of the robot's parts
    checks: tuple[Check, ...]  #: whether each joint is excited enough to tell its dynamics
    faults: tuple[Fault, ...]  #: what must not be


def assess(trajectory: Trajectory, dynamics: JointDynamics) -> Assessment:
    """Simulate a trajectory and judge it.

    The motion is simulated as in a fit, without contacts, and every step of it is then placed in the whole
    scene: as long as nothing comes near anything, contacts would change nothing.
    """
    (recording,) = simulated_recordings([trajectory], dynamics, PERFECT, np.random.default_rng(0))
    speed = np.diff(recording.q, axis=0) / FIT_DT
    near = clearances(recording.joints, recording.t_meas, recording.q, recording.workcell)
    return Assessment(
        recording=recording,
        speed=np.abs(speed).max(axis=0),
        torque_share=_torque_share(recording, speed, dynamics),
        clearances=near,
        checks=tuple(check for check in check_recording(recording) if check.name == "excitation"),
        faults=(*_limit_faults(recording, speed), *_clearance_faults(recording, near)),
    )


def _limit_faults(recording: Recording, speed: np.ndarray) -> list[Fault]:
    faults = []
    for column, joint in enumerate(recording.joints):
        spec, q = specs_of(recording.workcell)[joint], recording.q[:, column]
        excess, top = max(spec.lower - q.min(), q.max() - spec.upper), np.abs(speed[:, column]).max()
        if excess > LIMIT_TOLERANCE:
            faults.append(Fault(text=f"{joint} moves {excess:.3f} rad beyond its limits", joints=(joint,)))
        if top > spec.velocity_limit:
            text = f"{joint} reaches {top:.2f} rad/s of {spec.velocity_limit:.2f}"
            faults.append(Fault(text=text, joints=(joint,), remedy=0.95 * spec.velocity_limit / top))
    return faults


def _clearance_faults(recording: Recording, near: Sequence[Clearance]) -> list[Fault]:
    """Parts that come too near to each other; the arm is shrunk where it moves and has a part in it."""
    groups, faults = groups_of(recording.workcell), []
    for clearance in near:
        if not clearance.is_kept:
            role = "hand" if clearance.is_of_hand else "arm"
            moved = tuple(joint for joint in recording.joints if groups[joint].role == role)
            faults.append(Fault(text=clearance.sentence(), joints=moved or recording.joints))
    return faults


def _torque_share(
    recording: Recording, speed: np.ndarray, dynamics: JointDynamics
) -> Float64[np.ndarray, " num_joints"]:
    """Top torque of the servos, found backwards from the motion: what moves masses and overcomes friction."""
    model = recorded_model(recording.workcell, recording.joints, FIT_DT)
    model.dof_armature[:] = dynamics.armature
    data = mujoco.MjData(model)
    top = np.zeros(len(recording.joints))
    for q, before, jump in zip(recording.q[1:], speed, np.diff(speed, axis=0), strict=False):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, before, jump / FIT_DT
        mujoco.mj_inverse(model, data)
        friction = dynamics.frictionloss * np.sign(before)
        top = np.maximum(top, np.abs(data.qfrc_inverse + friction))
    return top / np.array([specs_of(recording.workcell)[joint].effort_limit for joint in recording.joints])
