"""Simulates recorded motions under many candidate dynamics at once: the forward model of the fit.

Torque limit, dry friction and command path are those of `envs`, in the limit of short time steps: a real
robot has none, so that what is identified must not depend on them. Joints that were not recorded are welded,
nothing touches anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from pixel2catch.errors import RecordingError
from pixel2catch.identification.commands import step_commands
from pixel2catch.identification.fit_servos import Filters, Servos
from pixel2catch.identification.recording import JOINT_SPECS, Recording
from pixel2catch.robot.joint_dynamics import JointDynamics, command_lag
from pixel2catch.robot.scene import SceneCfg, build_spec
from pixel2catch.sim.batch import BatchSimulation

FIT_DT = 1.0 / 480.0
"""Physics time step of a fit [s].

Source: ours; in excitation up to the torque limits, positions of the arm are within 0.03 mrad of those at
6 kHz, those of the hand within 0.08. With MuJoCo's implicit damping alone they would be off by up to 1.8.
"""

START_WINDOW = 0.1
"""Measurements that give the first position and speed [s]. Source: ours; a tenth of a servo's settling."""

SETTLING = 0.5
"""Time in which errors of the start fade [s]; it is not compared. Source: ours, 3.6 times damping over
stiffness of the slowest joint."""

MAX_COPIES = 96
"""Copies simulated at once, for the memory."""

THREADED_COPIES = 24
"""Copies from which on several threads are faster than one. Source: ours, measured with the arm."""


def recorded_model(joints: Sequence[str], physics_dt: float) -> mujoco.MjModel:
    """The robot with only these joints, without object, contacts, limits and MuJoCo's own dry friction."""
    spec = build_spec(SceneCfg())
    for element in (*spec.sensors, *spec.excludes):
        spec.delete(element)
    spec.delete(spec.body("object"))
    for name in JOINT_SPECS:
        if name not in joints:
            spec.delete(spec.actuator(name))
            spec.delete(spec.joint(name))
    spec.compiler.fusestatic = True
    spec.option.timestep = physics_dt
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    model.dof_frictionloss[:] = 0.0
    model.actuator_ctrllimited[:] = 0
    model.actuator_forcelimited[:] = 0
    return model


@dataclass(frozen=True, kw_only=True)
class _Motion:
    """A recording on the grid of physics steps.

    Attributes:
        recording: What was recorded.
        edges: Starts of the steps and the end of the last [s].
        start: Position [rad] and speed [rad/s] of each joint at the first measurement.
        is_settled: Which measurements are compared.
        index: For each of these, the edge before it.
        weight: And the share of the step after that edge.
    """

    recording: Recording
    edges: Float[np.ndarray, " num_edges"]
    start: Float[np.ndarray, "2 num_joints"]
    is_settled: np.ndarray
    index: np.ndarray
    weight: Float[np.ndarray, " num_settled"]

    @classmethod
    def of(cls, recording: Recording, dt: float) -> "_Motion":
        """Put a recording on the grid.

        Raises:
            RecordingError: It is too short to compare anything.
        """
        time = recording.t_meas - recording.t_meas[0]
        is_settled = time > SETTLING
        if np.count_nonzero(is_settled) < 10:
            raise RecordingError(
                f"{recording.name}: {time[-1]:.2f} s of measurements are too short; the first {SETTLING} s "
                "are not compared: record at least 10 samples more."
            )
        edges = recording.t_meas[0] + dt * np.arange(int(np.ceil(time[-1] / dt)) + 1)
        index = np.minimum((time[is_settled] / dt).astype(int), len(edges) - 2)
        return cls(
            recording=recording,
            edges=edges,
            start=_start(time, recording.q),
            is_settled=is_settled,
            index=index,
            weight=time[is_settled] / dt - index,
        )

    def sample(
        self, path: Float[np.ndarray, "num_edges num_joints"]
    ) -> Float[np.ndarray, "num_settled num_joints"]:
        """Simulated positions at the measurement times."""
        before, after = path[self.index], path[self.index + 1]
        return before + self.weight[:, None] * (after - before)


def _start(
    time: Float[np.ndarray, " num_samples"], q: Float[np.ndarray, "num_samples num_joints"]
) -> Float[np.ndarray, "2 num_joints"]:
    """First position and speed, by a parabola through the first measurements."""
    is_first = time <= START_WINDOW
    if np.count_nonzero(is_first) < 5:
        return np.stack((q[0], np.zeros_like(q[0])))
    coefficients = np.polynomial.polynomial.polyfit(time[is_first], q[is_first], 2)
    return coefficients[:2]


def _link_inertia(
    model: mujoco.MjModel, qpos: Float[np.ndarray, " num_joints"]
) -> Float[np.ndarray, " num_joints"]:
    """What each joint moves in a pose, without its armature [kg·m²]."""
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    return np.diagonal(inertia) - model.dof_armature


class RecordedMotion:
    """Some recordings of the same joints, ready to be simulated under any dynamics."""

    def __init__(self, recordings: Sequence[Recording], physics_dt: float = FIT_DT) -> None:
        """Build the model of the recorded joints.

        Args:
            recordings: At least one; all of the same joints, in joint order.
            physics_dt: Time step of the simulation [s].

        Raises:
            RecordingError: There is none, one is too short, or they are of different joints.
        """
        if not recordings:
            raise RecordingError("there is no recording to simulate; give at least one.")
        self.joints = recordings[0].joints
        for recording in recordings:
            if recording.joints != self.joints:
                raise RecordingError(
                    f"{recording.name}: joints {recording.joints}, but {recordings[0].name} has "
                    f"{self.joints}; give recordings of the same joints."
                )
        self._dt = physics_dt
        self._motions = [_Motion.of(recording, physics_dt) for recording in recordings]
        self._model = recorded_model(self.joints, physics_dt)
        self._link_inertia = _link_inertia(self._model, self._motions[0].start[0])

    @property
    def measured(self) -> Float[np.ndarray, "num_settled num_joints"]:
        """Measured positions that are compared, recording after recording [rad]."""
        return np.concatenate([motion.recording.q[motion.is_settled] for motion in self._motions])

    def simulate(
        self, candidates: Sequence[JointDynamics]
    ) -> Float[np.ndarray, "num_candidates num_settled num_joints"]:
        """Positions at the measurement times under each candidate [rad]."""
        chunk = max(1, MAX_COPIES // len(self._motions))
        parts = [self._simulate(candidates[i : i + chunk]) for i in range(0, len(candidates), chunk)]
        return np.concatenate(parts)

    def _simulate(self, candidates: Sequence[JointDynamics]) -> np.ndarray:
        """One batch: a copy for every recording under every candidate, candidate after candidate."""
        copies = [(candidate, motion) for candidate in candidates for motion in self._motions]
        paths = self._roll_out(copies)
        sampled = [motion.sample(paths[: len(motion.edges), i]) for i, (_, motion) in enumerate(copies)]
        num = len(self._motions)
        return np.stack([np.concatenate(sampled[i : i + num]) for i in range(0, len(sampled), num)])

    def _roll_out(
        self, copies: Sequence[tuple[JointDynamics, _Motion]]
    ) -> Float[np.ndarray, "num_edges num_copies num_joints"]:
        """Positions at every edge [rad]."""
        num_threads = 0 if len(copies) >= THREADED_COPIES else 1
        simulation = BatchSimulation(self._model, len(copies), num_threads)
        servos = Servos(simulation, [dynamics for dynamics, _ in copies], self._link_inertia, self._dt)
        qpos, qvel = (simulation.bind(name).numpy() for name in ("qpos", "qvel"))
        start = np.stack([motion.start for _, motion in copies], axis=1)
        qpos[:], qvel[:] = start
        path = Filters(self._dt, start, [dynamics for dynamics, _ in copies])
        commands, index = _commands(copies, self._dt)
        paths = np.empty((len(commands) + 1, *qpos.shape))
        paths[0] = qpos
        for k, arriving in enumerate(commands):
            mean, first, last, share = arriving.take(index, axis=1)
            target = path.advance(mean)
            servos.drive(target + first, target + last, share)
            simulation.step()
            paths[k + 1] = qpos
        return paths


def _commands(copies: Sequence[tuple[JointDynamics, _Motion]], dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Delayed commands, as `step_commands` has them; a short recording holds its last.

    Returns:
        The different ones, (num_steps, 4, num_different, num_joints), and which of them is each copy's.
    """
    known: dict[tuple[int, bytes, bytes], np.ndarray] = {}
    keys = []
    num_steps = max(len(motion.edges) for _, motion in copies) - 1
    for dynamics, motion in copies:
        lag = command_lag(dynamics, dt)
        keys.append((id(motion), lag.tobytes(), dynamics.has_filter.tobytes()))
        if keys[-1] not in known:
            recording = motion.recording
            values = step_commands(recording.t_cmd, recording.q_cmd, motion.edges, lag)
            values[:, 1:3, dynamics.has_filter] = 0.0  # a filter turns jumps into slopes
            known[keys[-1]] = np.pad(values, ((0, num_steps - len(values)), (0, 0), (0, 0)), mode="edge")
    order = list(known)
    return np.stack(list(known.values()), axis=2), np.array([order.index(key) for key in keys])
