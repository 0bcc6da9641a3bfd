"""Simulates recorded motions under many candidate dynamics at once: the forward model of the fit.

Torque limit, dry friction and command path are those of `envs`, in the limit of short time steps: a real
robot has none, so that what is identified must not depend on them. Joints that were not recorded are welded,
nothing touches anything.

NumPy does in a few microseconds what takes PyTorch tens, and a fit is many steps of few copies. Arrays of the
servos are of shape (num_copies, num_joints); in every step their shapes are left unchecked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from pixel2catch.envs.actuators import EFFORT_MARGIN
from pixel2catch.errors import RecordingError
from pixel2catch.identification.encoders import Encoders, behind_play
from pixel2catch.identification.joints import groups_of, hanging_on, recorded_model, specs_of
from pixel2catch.identification.recording import Recording, held
from pixel2catch.robots.joint_dynamics import (
    DryFriction,
    JointDynamics,
    command_lag,
    filter_step,
    filter_transition,
)
from pixel2catch.sim.batch import BatchSimulation

FIT_DT = 1.0 / 480.0
"""Physics time step of a fit [s]. Source: ours; in excitation up to the torque limits, positions of the arm
are within 0.03 mrad of those at 6 kHz, those of the hand within 0.08. With MuJoCo's implicit damping alone
they would be off by up to 1.8."""

START_WINDOW = 0.1  # measurements whose parabola begins a motion [s] (ours, a tenth of a settling)

SETTLING = 0.5
"""Time in which errors of the start fade [s]; it is not compared. Source: ours, 3.6 times damping over
stiffness of the slowest joint."""

MAX_COPIES = 96  # copies simulated at once, for the memory
THREADED_COPIES = 24  # copies from which on several threads are faster than one (ours, measured with the arm)

Times = Float[np.ndarray, " num_commands"]
Commands = Float[np.ndarray, "num_commands num_joints"]
Edges = Float[np.ndarray, " num_edges"]
PerJoint = Float[np.ndarray, " num_joints"]
Settled = Float[np.ndarray, "num_settled num_joints"]


def mean_commands(
    t_cmd: Times, q_cmd: Commands, edges: Edges, latency: PerJoint
) -> Float[np.ndarray, "num_steps num_joints"]:
    """Mean of the held, delayed commands over every time step: it depends smoothly on the latency.

    Times [s], commands [rad] and latency [s] are as in a recording and a `JointDynamics`; the edges are the
    starts of the steps, and the end of the last [s].
    """
    end = max(float(edges[-1]), float(t_cmd[-1])) + 1.0
    start = min(float(edges[0]) - float(latency.max()), float(t_cmd[0])) - 1.0
    knots = np.concatenate(([start], t_cmd, [end]))
    values = np.concatenate((q_cmd[:1], q_cmd))
    area = np.cumsum(np.diff(knots)[:, None] * values, axis=0)
    area = np.concatenate((np.zeros((1, values.shape[1])), area))
    areas = [np.interp(edges - delay, knots, area[:, j]) for j, delay in enumerate(latency)]
    return np.diff(np.stack(areas, axis=-1), axis=0) / np.diff(edges)[:, None]


def step_commands(
    t_cmd: Times, q_cmd: Commands, edges: Edges, latency: PerJoint
) -> Float[np.ndarray, "num_steps 4 num_joints"]:
    """What arrives in every time step: a command, and from some moment on the next one.

    A servo at its torque limit does not answer to their mean, so that the moment must be known. Where several
    commands of a step are no such pair, there is their mean only. Arguments as of `mean_commands`. Returned
    are their mean [rad]; by how much the first and the last are beyond it [rad]; the share of the first.
    """
    mean = mean_commands(t_cmd, q_cmd, edges, latency)
    sent = [held(t_cmd, q_cmd[:, j : j + 1], edges - delay) for j, delay in enumerate(latency)]
    arrived = np.concatenate(sent, axis=1)
    first, last = arrived[:-1] - mean, arrived[1:] - mean
    jump = first - last
    share = np.divide(-last, jump, out=np.full_like(mean, -1.0), where=jump != 0.0)
    is_pair = (share >= 0.0) & (share <= 1.0)
    columns = (mean, is_pair * first, is_pair * last, np.where(is_pair, share, 0.5))
    return np.stack(columns, axis=1)


class Servos:
    """The servos of all copies: those of `envs/actuators.py` in the limit of short time steps.

    MuJoCo's implicit damping acts on the speed at the end of a step, as if the armature were larger by
    damping · dt / 2, which for the arm is as much as the armature itself. So half of it is implicit here,
    which is the trapezoidal rule, and a servo that stays at its torque limit is a torque alone. What
    is identified then hardly depends on the time step.
    """

    def __init__(
        self,
        simulation: BatchSimulation,
        dynamics: Sequence[JointDynamics],
        efforts: PerJoint,
        link_inertia: PerJoint,
        dt: float,
    ) -> None:
        """Give every copy, which is where it begins, its dynamics and largest torques [N·m].

        The inertia of the links is what a joint moves beside its armature [kg·m²]; the time step is in [s].
        """
        self._stiffness, self._damping, frictionloss, armature = (
            np.stack([getattr(each, name) for each in dynamics])
            for name in ("stiffness", "damping", "frictionloss", "armature")
        )
        self._dt, self._half, self._inertia = dt, self._damping / 2, armature + link_inertia
        self._limit = EFFORT_MARGIN * efforts
        simulation.expand("dof_armature").numpy()[:] = armature
        simulation.expand("actuator_gainprm").numpy()[:, :, 0] = self._stiffness
        bias = simulation.expand("actuator_biasprm").numpy()
        bias[:, :, 1] = -self._stiffness
        self._bias = bias[:, :, 2]
        self._ctrl, self._applied, self._qpos, self._qvel = (
            simulation.bind(name).numpy() for name in ("ctrl", "qfrc_applied", "qpos", "qvel")
        )
        self._friction = DryFriction(frictionloss, armature, self._qpos, dt)

    def drive(self, first: np.ndarray, last: np.ndarray, share: np.ndarray) -> None:
        """Set what drives the joints in the next step, of which the first target [rad] holds in a share."""
        resting = self._stiffness * self._qpos + self._damping * self._qvel
        (before, time_before), (after, time_after) = (
            self._limited(self._stiffness * target - resting) for target in (first, last)
        )
        is_at_limit = (np.minimum(time_before, time_after) >= self._dt) & (before * after > 0.0)
        torque = np.where(is_at_limit, np.copysign(self._limit, after), after + share * (before - after))
        implicit = np.where(is_at_limit, 0.0, self._half)
        self._bias[:] = -implicit
        self._ctrl[:] = self._qpos + (torque + implicit * self._qvel) / self._stiffness
        self._applied[:] = self._friction.torque(self._qpos)

    def _limited(self, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean torque of a step in which an unlimited servo would begin with one, and the time at the limit.

        There the joint accelerates at the limit until damping has brought the servo below it, and follows the
        trapezoidal rule from then on. The result gives the same speed at the end of the step.
        """
        excess = np.maximum(np.abs(torque) - self._limit, 0.0)
        at_limit = np.minimum(excess / (self._limit * self._damping) * self._inertia, self._dt)
        rest = self._dt - at_limit
        gain = at_limit / self._inertia + rest / (self._inertia + self._half * rest)
        mean = self._limit * gain * (self._inertia / self._dt + self._half)
        return np.where(excess > 0.0, np.copysign(mean, torque), torque), at_limit


class CommandFilters:
    """The command filters of all copies; commands pass unchanged where no joint has a filter."""

    def __init__(
        self,
        dt: float,
        start: Float[np.ndarray, "2 num_copies num_joints"],
        dynamics: Sequence[JointDynamics],
    ) -> None:
        """Begin with positions [rad] and speeds [rad/s] of the joints; the time step is in [s]."""
        self._transition = np.stack([filter_transition(each, dt) for each in dynamics])
        self._state = np.moveaxis(start, 0, -1).copy()
        self._is_there = any(each.has_filter.any() for each in dynamics)

    def step(self, command: np.ndarray) -> np.ndarray:
        """Return the targets of the servos [rad] after a time step with a command [rad]."""
        if not self._is_there:
            return command
        filter_step(self._transition, self._state, command)
        return self._state[..., 0]


@dataclass(frozen=True, kw_only=True)
class _Motion:
    """A recording on the grid of physics steps."""

    recording: Recording  #: what was recorded
    edges: Edges  #: starts of the steps and the end of the last [s]
    start: Float[np.ndarray, "2 num_joints"]  #: positions [rad] and speeds [rad/s] at the first measurement
    index: Int[np.ndarray, " num_settled"]  #: for each measurement that is compared, the edge before it
    weight: Float[np.ndarray, " num_settled"]  #: and the share of the step after that edge

    @classmethod
    def of(cls, recording: Recording, dt: float) -> "_Motion":
        """Put a recording on the grid.

        Raises:
            RecordingError: It is too short to compare anything.
        """
        time = recording.t_meas - recording.t_meas[0]
        settled = time[is_settled(recording)]
        if len(settled) < 10:
            raise RecordingError(
                f"{recording.name}: {time[-1]:.2f} s of measurements are too short; the first {SETTLING} s "
                "are not compared: record at least 10 samples more."
            )
        edges = recording.t_meas[0] + dt * np.arange(int(np.ceil(time[-1] / dt)) + 1)
        index = np.minimum((settled / dt).astype(int), len(edges) - 2)
        start, is_first = np.stack((recording.q[0], np.zeros_like(recording.q[0]))), time <= START_WINDOW
        if np.count_nonzero(is_first) >= 5:
            start = np.polynomial.polynomial.polyfit(time[is_first], recording.q[is_first], 2)[:2]
        weight = settled / dt - index
        return cls(recording=recording, edges=edges, start=start, index=index, weight=weight)

    def sample(self, path: Float[np.ndarray, "num_edges num_joints"], drift: PerJoint) -> Settled:
        """Simulated positions at the measurement times of clocks that drift."""
        if not drift.any():
            before, after = path[self.index], path[self.index + 1]
            return before + self.weight[:, None] * (after - before)
        steps = np.arange(len(path))
        places = (self.index + self.weight)[:, None] * (1.0 - drift)
        return np.stack(
            [np.interp(*pair) for pair in zip(places.T, [steps] * len(drift), path.T, strict=True)], axis=-1
        )


def is_settled(recording: Recording) -> Bool[np.ndarray, " num_samples"]:
    """Which measurements are compared: all but those while errors of the start fade."""
    return recording.t_meas - recording.t_meas[0] > SETTLING


class RecordedMotion:
    """Some recordings of the same joints, ready to be simulated under any dynamics."""

    def __init__(self, recordings: Sequence[Recording], physics_dt: float = FIT_DT) -> None:
        """Build the model of the recorded joints, which are the same in all, with a time step [s].

        Raises:
            RecordingError: There is none, one is too short, or they are of different joints.
        """
        if not recordings:
            raise RecordingError("there is no recording to simulate; give at least one.")
        self.joints, workcell = recordings[0].joints, recordings[0].workcell
        for recording in recordings:
            if recording.joints != self.joints:
                raise RecordingError(
                    f"{recording.name}: joints {recording.joints}, but {recordings[0].name} has "
                    f"{self.joints}; give recordings of the same joints."
                )
        self._dt = physics_dt
        self.groups = np.array([groups_of(workcell)[name].name for name in self.joints])  # of each joint
        self._efforts = np.array([specs_of(workcell)[name].effort_limit for name in self.joints])
        self._motions = [_Motion.of(recording, physics_dt) for recording in recordings]
        self._model = recorded_model(workcell, self.joints, physics_dt)
        data, inertia = mujoco.MjData(self._model), np.zeros((self._model.nv, self._model.nv))
        data.qpos[:] = self._motions[0].start[0]
        mujoco.mj_forward(self._model, data)
        mujoco.mj_fullM(self._model, data, inertia)
        self.link_inertia = np.diagonal(inertia) - self._model.dof_armature  # beside the armature [kg·m²]

    @property
    def coupled(self) -> Bool[np.ndarray, "num_joints num_joints"]:
        """Which joints (columns) each one moves: the rest of its chain in its group, and what hangs on it."""
        hangs = hanging_on(self._model.dof_parentid)
        return hangs | (hangs.T & (self.groups[:, None] == self.groups))

    @property
    def measured(self) -> Settled:
        """Measured positions that are compared, recording after recording [rad]."""
        recordings = [motion.recording for motion in self._motions]
        return np.concatenate([recording.q[is_settled(recording)] for recording in recordings])

    def block_starts(self, seconds: float) -> Int[np.ndarray, " num_blocks"]:
        """Where blocks of about a length [s] begin among the measurements compared."""
        starts, num_before = [], 0
        for motion in self._motions:
            time = motion.recording.t_meas[is_settled(motion.recording)]
            edges = np.linspace(time[0], time[-1], max(1, round(np.ptp(time) / seconds)), endpoint=False)
            starts.append(num_before + np.unique(np.searchsorted(time, edges)))
            num_before += len(time)
        return np.concatenate(starts)

    def split(self, positions: Settled) -> list[np.ndarray]:
        """Simulated positions, recording by recording."""
        return np.split(positions, np.cumsum([len(motion.index) for motion in self._motions])[:-1])

    def simulate(
        self, candidates: Sequence[JointDynamics], encoders: Sequence[Encoders] = ()
    ) -> Float[np.ndarray, "num_candidates num_settled num_joints"]:
        """What encoders read at the measurement times under each candidate [rad]; perfect ones by default.

        Candidates that are the same are simulated once, however they are measured.
        """
        num = len(self._motions)
        encoders = encoders or [Encoders.perfect(num, len(self.joints))] * len(candidates)
        different = list(dict.fromkeys(candidates))
        chunk = max(1, MAX_COPIES // num)
        batches = [different[i : i + chunk] for i in range(0, len(different), chunk)]
        copies = [[(each, motion) for each in batch for motion in self._motions] for batch in batches]
        paths = [path for batch in copies for path in np.moveaxis(self._roll_out(batch), 1, 0)]
        measured = []
        for candidate, own in zip(candidates, encoders, strict=True):
            first = num * different.index(candidate)
            parts = [
                behind_play(motion.sample(path[: len(motion.edges)], drift), own.play)
                for motion, path, drift in zip(
                    self._motions, paths[first : first + num], own.drift, strict=True
                )
            ]
            measured.append(np.concatenate(parts))
        return np.stack(measured)

    def _roll_out(
        self, copies: Sequence[tuple[JointDynamics, _Motion]]
    ) -> Float[np.ndarray, "num_edges num_copies num_joints"]:
        """Positions at every edge [rad]."""
        num_threads = 0 if len(copies) >= THREADED_COPIES else 1
        simulation = BatchSimulation(self._model, len(copies), num_threads)
        candidates = [dynamics for dynamics, _ in copies]
        qpos, qvel = (simulation.bind(name).numpy() for name in ("qpos", "qvel"))
        start = np.stack([motion.start for _, motion in copies], axis=1)
        qpos[:], qvel[:] = start
        servos = Servos(simulation, candidates, self._efforts, self.link_inertia, self._dt)
        filters = CommandFilters(self._dt, start, candidates)
        commands, index = _commands(copies, self._dt)
        paths = np.empty((len(commands) + 1, *qpos.shape))
        paths[0] = qpos
        for k, arriving in enumerate(commands):
            mean, first, last, share = arriving.take(index, axis=1)
            target = filters.step(mean)
            servos.drive(target + first, target + last, share)
            simulation.step()
            paths[k + 1] = qpos
        return paths


def _commands(copies: Sequence[tuple[JointDynamics, _Motion]], dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Delayed commands, as `step_commands` has them; a short recording holds its last.

    They are the different ones, (num_steps, 4, num_different, num_joints), and which of them is each copy's.
    """
    known: dict[tuple[int, bytes, bytes], np.ndarray] = {}
    keys = []
    num_steps = max(len(motion.edges) for _, motion in copies) - 1
    for dynamics, motion in copies:
        lag = command_lag(dynamics, dt)
        keys.append((id(motion), lag.tobytes(), dynamics.has_filter.tobytes()))
        if keys[-1] not in known:
            values = step_commands(motion.recording.t_cmd, motion.recording.q_cmd, motion.edges, lag)
            values[:, 1:3, dynamics.has_filter] = 0.0  # a filter turns jumps into slopes
            known[keys[-1]] = np.pad(values, ((0, num_steps - len(values)), (0, 0), (0, 0)), mode="edge")
    order = list(known)
    return np.stack(list(known.values()), axis=2), np.array([order.index(key) for key in keys])
