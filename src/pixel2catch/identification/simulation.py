"""Simulate recorded motions under many candidate dynamics at once: the forward model of the fit.

Torque limit, dry friction and command path are those of `envs`, in the limit of short time steps. Joints that
were not recorded are welded, and there are no contacts. The servos' arrays are NumPy's, which is faster than
PyTorch for few copies, shape (num_copies, num_joints).
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco.batch import Batch

from pixel2catch.errors import RecordingError
from pixel2catch.identification.recording import Recording, groups_of, held, specs_of
from pixel2catch.robots.joint_dynamics import EFFORT_MARGIN, DryFriction, JointDynamics, filter_step
from pixel2catch.robots.workcell import WorkcellSpec, add_robots

FIT_DT = 1.0 / 480.0
"""Physics time step of a fit [s]. Source: ours; at the torque limits, positions of the arm are within
0.03 mrad of those at 6 kHz, of the hand within 0.08."""

START_WINDOW = 0.1  # measurements whose parabola gives the start of a motion [s] (ours)
SETTLING = 0.5  # time in which errors of the start fade [s] (ours, 3.6 damping / stiffness)
MAX_COPIES = 96  # most copies simulated at once, limits the memory
THREADED_COPIES = 24  # least copies for which several threads are faster than one (ours)

Edges = Float[np.ndarray, " num_edges"]
PerJoint = Float[np.ndarray, " num_joints"]
Positions = Float[np.ndarray, "num_times num_joints"]
Settled = Float[np.ndarray, "num_settled num_joints"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Encoders:
    """Errors between the motion of joints and its recording: play, clocks that drift apart, and zeros."""

    play: PerJoint  #: width of the play between servo and encoder [rad]; the encoder lags by half of it
    #: excess speed of the measurements' clock over that of the commands, as a share
    drift: Float[np.ndarray, "num_recordings num_joints"]
    zero: Float[np.ndarray, "num_recordings num_joints"]  #: what they read where the joints are at zero [rad]

    @classmethod
    def perfect(cls, num_recordings: int, num_joints: int) -> "Encoders":
        """Return encoders without errors."""
        each = np.zeros((num_recordings, num_joints))
        return cls(play=np.zeros(num_joints), drift=each, zero=each)


def behind_play(positions: Positions, play: PerJoint) -> Positions:
    """Return what encoders behind a play [rad] measure while their joints are at some positions [rad]."""
    if not play.any():
        return positions
    low, high = positions - play / 2, positions + play / 2
    read, now = np.empty_like(positions), positions[0]
    for k in range(len(positions)):
        now = np.minimum(np.maximum(now, low[k]), high[k])
        read[k] = now
    return read


def recorded_model(workcell: WorkcellSpec, joints: Sequence[str], physics_dt: float) -> mujoco.MjModel:
    """Return the robots with these joints, the others welded in the start pose, at a time step [s].

    They have position servos without gains; no contacts and limits, and none of MuJoCo's dry friction.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.timestep = physics_dt
    add_robots(spec, workcell, visuals=False)
    for exclude in spec.excludes:
        spec.delete(exclude)
    whole = spec.compile()
    for name, joint in specs_of(workcell).items():
        element = spec.joint(name)
        if name in joints:
            element.armature = joint.armature
            bias = mujoco.mjtBias.mjBIAS_AFFINE
            spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, biastype=bias)
            continue
        body, turned, turn = element.parent, np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, element.axis, joint.home)
        mujoco.mju_mulQuat(turned, whole.body(body.name).quat, turn)
        body.quat, body.alt.type = turned, mujoco.mjtOrientation.mjORIENTATION_QUAT
        spec.delete(element)
    spec.compiler.fusestatic = True
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    model.dof_frictionloss[:] = 0.0
    return model


def step_commands(
    t_cmd: np.ndarray, q_cmd: np.ndarray, edges: Edges, latency: PerJoint
) -> Float[np.ndarray, "num_steps 4 num_joints"]:
    """Return what arrives in every time step: a command, and from some moment on the next one.

    They are the mean [rad], which depends smoothly on the latency, first and last command minus the mean
    [rad], and the share of the step in which the first holds, which matters at a torque limit. Where the
    commands of a step are not such a pair, only the mean counts.
    """
    end = max(float(edges[-1]), float(t_cmd[-1])) + 1.0
    start = min(float(edges[0]) - float(latency.max()), float(t_cmd[0])) - 1.0
    knots = np.concatenate(([start], t_cmd, [end]))
    area = np.cumsum(np.diff(knots)[:, None] * np.concatenate((q_cmd[:1], q_cmd)), axis=0)
    area = np.concatenate((np.zeros((1, area.shape[1])), area))
    areas = [np.interp(edges - delay, knots, area[:, j]) for j, delay in enumerate(latency)]
    mean = np.diff(np.stack(areas, axis=-1), axis=0) / np.diff(edges)[:, None]
    sent = [held(t_cmd, q_cmd[:, j : j + 1], edges - delay) for j, delay in enumerate(latency)]
    arrived = np.concatenate(sent, axis=1)
    first, last = arrived[:-1] - mean, arrived[1:] - mean
    jump = first - last
    share = np.divide(-last, jump, out=np.full_like(mean, -1.0), where=jump != 0.0)
    is_pair = (share >= 0.0) & (share <= 1.0)
    columns = (mean, is_pair * first, is_pair * last, np.where(is_pair, share, 0.5))
    return np.stack(columns, axis=1)


class RecordedServos:
    """Servos of all copies: those of `envs/actuators.py` in the limit of short time steps.

    MuJoCo's implicit damping acts as if the armature were larger by damping · dt / 2. So half of it is
    implicit here, the trapezoidal rule, and a servo that stays at its torque limit is a torque alone.
    """

    def __init__(
        self,
        batch: Batch,
        dynamics: Sequence[JointDynamics],
        efforts: PerJoint,
        link_inertia: PerJoint,
        dt: float,
    ) -> None:
        """Set dynamics, largest torques [N·m], inertia beside the armature [kg·m²] and time step [s]."""
        names = ("stiffness", "damping", "frictionloss", "armature")
        arrays = [np.stack([getattr(each, name) for each in dynamics]) for name in names]
        self._stiffness, self._damping, frictionloss, armature = arrays
        self._dt, self._half, self._inertia = dt, self._damping / 2, armature + link_inertia
        self._limit = EFFORT_MARGIN * efforts
        batch.expand("dof_armature")[:] = armature
        batch.expand("actuator_gainprm")[:, :, 0] = self._stiffness
        bias = batch.expand("actuator_biasprm")
        bias[:, :, 1] = -self._stiffness
        self._bias = bias[:, :, 2]
        self._ctrl, self._applied, self._qpos, self._qvel = (
            batch.bind(name) for name in ("ctrl", "qfrc_applied", "qpos", "qvel")
        )
        self._friction = DryFriction(frictionloss, armature, self._qpos, dt)

    def drive(self, first: np.ndarray, last: np.ndarray, share: np.ndarray) -> None:
        """Set the torques of the next step, in whose first share the first target [rad] holds."""
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
        """Return the mean torque of a step that begins with a torque, and the time at the limit [s].

        At the limit the joint accelerates until damping has brought the servo below it, and follows the
        trapezoidal rule from then on. The mean torque gives the same speed at the end of the step.
        """
        excess = np.maximum(np.abs(torque) - self._limit, 0.0)
        at_limit = np.minimum(excess / (self._limit * self._damping) * self._inertia, self._dt)
        rest = self._dt - at_limit
        gain = at_limit / self._inertia + rest / (self._inertia + self._half * rest)
        mean = self._limit * gain * (self._inertia / self._dt + self._half)
        return np.where(excess > 0.0, np.copysign(mean, torque), torque), at_limit


@dataclass(frozen=True, kw_only=True)
class _Grid:
    """A recording on the grid of physics steps."""

    recording: Recording
    edges: Edges  #: starts of the steps and the end of the last [s]
    start: Float[np.ndarray, "2 num_joints"]  #: positions [rad] and speeds [rad/s] at the first measurement
    index: Int[np.ndarray, " num_settled"]  #: for each measurement that is compared, the edge before it
    weight: Float[np.ndarray, " num_settled"]  #: and the share of the step after that edge

    @classmethod
    def of(cls, recording: Recording, dt: float) -> "_Grid":
        """Put a recording on the grid; raise RecordingError if it is too short to compare anything."""
        time = recording.t_meas - recording.t_meas[0]
        settled = time[is_settled(recording)]
        if len(settled) < 10:
            fix = f"the first {SETTLING} s are not compared: record at least 10 samples more"
            raise RecordingError(f"{recording.name}: {time[-1]:.2f} s of measurements are too short; {fix}.")
        edges = recording.t_meas[0] + dt * np.arange(int(np.ceil(time[-1] / dt)) + 1)
        index = np.minimum((settled / dt).astype(int), len(edges) - 2)
        start, is_first = np.stack((recording.q[0], np.zeros_like(recording.q[0]))), time <= START_WINDOW
        if np.count_nonzero(is_first) >= 5:
            start = np.polynomial.polynomial.polyfit(time[is_first], recording.q[is_first], 2)[:2]
        return cls(recording=recording, edges=edges, start=start, index=index, weight=settled / dt - index)

    def sample(self, path: Float[np.ndarray, "num_edges num_joints"], drift: PerJoint) -> Settled:
        """Return simulated positions at the measurement times of clocks that drift."""
        if not drift.any():
            before, after = path[self.index], path[self.index + 1]
            return before + self.weight[:, None] * (after - before)
        places = (self.index + self.weight)[:, None] * (1.0 - drift)
        steps, pairs = np.arange(len(path)), zip(places.T, path.T, strict=True)
        return np.stack([np.interp(place, steps, own) for place, own in pairs], axis=-1)


def is_settled(recording: Recording) -> Bool[np.ndarray, " num_samples"]:
    """Return which measurements are compared: all after the time in which errors of the start fade."""
    return recording.t_meas - recording.t_meas[0] > SETTLING


class RecordedMotion:
    """Recordings of the same joints that can be simulated under any dynamics."""

    def __init__(self, recordings: Sequence[Recording], physics_dt: float = FIT_DT) -> None:
        """Build the model of the recorded joints, which are the same in all, with a time step [s]."""
        if not recordings:
            raise RecordingError("there is no recording to simulate; give at least one.")
        self.joints, workcell = recordings[0].joints, recordings[0].workcell
        for recording in recordings:
            if recording.joints != self.joints:
                others = f"{recordings[0].name} has {self.joints}; give recordings of the same joints"
                raise RecordingError(f"{recording.name}: joints {recording.joints}, but {others}.")
        self._dt = physics_dt
        self.groups = np.array([groups_of(workcell)[name].name for name in self.joints])  # of each joint
        self._efforts = np.array([specs_of(workcell)[name].effort_limit for name in self.joints])
        self._grids = [_Grid.of(recording, physics_dt) for recording in recordings]
        self._model = recorded_model(workcell, self.joints, physics_dt)
        data, inertia = mujoco.MjData(self._model), np.zeros((self._model.nv, self._model.nv))
        data.qpos[:] = self._grids[0].start[0]
        mujoco.mj_forward(self._model, data)
        mujoco.mj_fullM(self._model, data, inertia)
        self.link_inertia = np.diagonal(inertia) - self._model.dof_armature  # beside the armature [kg·m²]

    @property
    def coupled(self) -> Bool[np.ndarray, "num_joints num_joints"]:
        """Return which joints (columns) each joint moves: its chain in its group, and what hangs on it."""
        hangs = np.eye(len(self.joints), dtype=bool)
        for joint, parent in enumerate(self._model.dof_parentid):
            hangs[:, joint] |= hangs[:, parent] & (parent >= 0)
        return hangs | (hangs.T & (self.groups[:, None] == self.groups))

    @property
    def measured(self) -> Settled:
        """Return the measured positions that are compared, recording after recording [rad]."""
        recordings = [grid.recording for grid in self._grids]
        return np.concatenate([recording.q[is_settled(recording)] for recording in recordings])

    def block_starts(self, seconds: float) -> Int[np.ndarray, " num_blocks"]:
        """Return where blocks of about a length [s] begin among the measurements that are compared."""
        starts, num_before = [], 0
        for grid in self._grids:
            time = grid.recording.t_meas[is_settled(grid.recording)]
            edges = np.linspace(time[0], time[-1], max(1, round(np.ptp(time) / seconds)), endpoint=False)
            starts.append(num_before + np.unique(np.searchsorted(time, edges)))
            num_before += len(time)
        return np.concatenate(starts)

    def split(self, positions: Float[np.ndarray, "*points num_settled num_joints"]) -> list[np.ndarray]:
        """Return views of simulated positions, recording by recording."""
        return np.split(positions, np.cumsum([len(grid.index) for grid in self._grids])[:-1], axis=-2)

    def simulate(
        self, candidates: Sequence[JointDynamics], encoders: Sequence[Encoders] = ()
    ) -> Float[np.ndarray, "num_candidates num_settled num_joints"]:
        """Return the encoders' measurements under each candidate [rad]; without `encoders` they are perfect.

        Equal candidates are simulated once.
        """
        num = len(self._grids)
        encoders = encoders or [Encoders.perfect(num, len(self.joints))] * len(candidates)
        different = list(dict.fromkeys(candidates))
        chunk = max(1, MAX_COPIES // num)
        batches = [different[i : i + chunk] for i in range(0, len(different), chunk)]
        copies = [[(each, grid) for each in batch for grid in self._grids] for batch in batches]
        paths = [path for batch in copies for path in np.moveaxis(self._roll_out(batch), 1, 0)]
        measured = []
        for candidate, own in zip(candidates, encoders, strict=True):
            first = num * different.index(candidate)
            own_paths = zip(self._grids, paths[first : first + num], own.drift, strict=True)
            sampled = [grid.sample(path[: len(grid.edges)], drift) for grid, path, drift in own_paths]
            pairs = zip(sampled, own.zero, strict=True)
            measured.append(np.concatenate([zero + behind_play(each, own.play) for each, zero in pairs]))
        return np.stack(measured)

    def _roll_out(
        self, copies: Sequence[tuple[JointDynamics, _Grid]]
    ) -> Float[np.ndarray, "num_edges num_copies num_joints"]:
        """Simulate all copies; return joint positions at the edges of the physics steps [rad]."""
        num_threads = min(len(os.sched_getaffinity(0)), len(copies)) if len(copies) >= THREADED_COPIES else 1
        batch = Batch(self._model, len(copies), num_threads, persistent=True)
        candidates = [dynamics for dynamics, _ in copies]
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        start = np.stack([grid.start for _, grid in copies], axis=1)
        qpos[:], qvel[:] = start
        servos = RecordedServos(batch, candidates, self._efforts, self.link_inertia, self._dt)
        transition = np.stack([each.filter_transition(self._dt) for each in candidates])
        filtered = np.moveaxis(start, 0, -1).copy()  # state of the command filters
        has_filter = any(each.has_filter.any() for each in candidates)
        commands, index = _commands(copies, self._dt)
        paths = np.empty((len(commands) + 1, *qpos.shape))
        paths[0] = qpos
        for k, arriving in enumerate(commands):
            mean, first, last, share = arriving.take(index, axis=1)
            target = mean
            if has_filter:
                filter_step(transition, filtered, mean)
                target = filtered[..., 0]
            servos.drive(target + first, target + last, share)
            batch.step(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
            paths[k + 1] = qpos
        return paths


def _commands(copies: Sequence[tuple[JointDynamics, _Grid]], dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the different delayed commands as `step_commands` does, and which of them each copy has.

    Their shape is (num_steps, 4, num_different, num_joints); a short recording holds its last command.
    """
    known: dict[tuple[int, bytes, bytes], np.ndarray] = {}
    keys = []
    num_steps = max(len(grid.edges) for _, grid in copies) - 1
    for dynamics, grid in copies:
        lag = dynamics.command_lag(dt)
        keys.append((id(grid), lag.tobytes(), dynamics.has_filter.tobytes()))
        if keys[-1] not in known:
            values = step_commands(grid.recording.t_cmd, grid.recording.q_cmd, grid.edges, lag)
            values[:, 1:3, dynamics.has_filter] = 0.0  # a filter turns jumps into slopes
            known[keys[-1]] = np.pad(values, ((0, num_steps - len(values)), (0, 0), (0, 0)), mode="edge")
    order = list(known)
    return np.stack(list(known.values()), axis=2), np.array([order.index(key) for key in keys])
