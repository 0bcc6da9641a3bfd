"""The simulated laboratory: robot, object and thrower in steps of the physics, and the score of a throw."""

from dataclasses import dataclass, replace
from enum import StrEnum
from math import inf, pi
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float

from pixel2catch.camera.pinhole import nominal_projection
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.episode import Episode, EpisodeRecord, StepExtremes, draw_episode
from pixel2catch.envs.world import CatchWorld
from pixel2catch.errors import DeploymentError
from pixel2catch.evaluation.protocol import TRIAL_STEPS
from pixel2catch.mdp.randomization import by_joint
from pixel2catch.mdp.sensing import detect
from pixel2catch.mdp.terminations import is_lost
from pixel2catch.rendering.camera import Exposure, Moment
from pixel2catch.rendering.room import Bystanders
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.constants import CameraSpec
from pixel2catch.servo.limits import BEYOND_TRAVEL, steady_lag
from pixel2catch.workcells import find_workcell

EMPTY_TIME = 0.5  #: Time without an object before each throw [s]. Source: ours.

BEYOND_LIMITS = torch.tensor((-BEYOND_TRAVEL, BEYOND_TRAVEL))
"""Added to the limits of the arm's joints: commands end at the limits, the joints do not [rad]."""

ENCODER_STEP = {"arm": 9.5e-6, "hand": 8.9e-5}
"""Step of measured positions by the role of a joint group [rad].

Source: arm: recorded positions of a real UR5 are multiples of it (of 8.1e-6 at its wrists), and are equal to
the last bit at rest; hand: its maker's driver, 333.3° in 65,536 counts.
"""

ENCODER_NOISE = 0.3  #: Standard deviation of a position before it is rounded [steps]. Source: ours.

Joints = Float[np.ndarray, " num_joints"]

_YES = torch.ones(1, dtype=torch.bool)


@dataclass(frozen=True, kw_only=True)
class JointState:
    """Position and velocity of some joints."""

    position: Float[np.ndarray, " num_joints"]  #: [rad]
    velocity: Float[np.ndarray, " num_joints"]  #: [rad/s]


class Phase(StrEnum):
    """Phase of a throw."""

    EMPTY = "empty"  #: There is no object in the room.
    HELD = "held"  #: The thrower holds the object.
    FLYING = "flying"  #: The object was released, and the throw is not decided.
    OVER = "over"  #: The object was caught or dropped, or the time is over.


@final
class SimulatedLab:
    """The simulation in steps of its physics, without real time. Close it.

    Throws, dynamics and encoder offsets are those of the task. Its noise of encoders, errors of actions and
    delays are not applied: encoders round as those of real drivers, and delays come from the network.
    Drives and drivers read the same encoders: an offset moves the joint, and no reading.

    A throw is scored at the control rate, from its release until it is decided. The time limit of a success
    includes the steps for which the object hovers in an episode, not the time for which the operator waits.
    """

    def __init__(self, task: CatchEnvCfg, seed: int) -> None:
        self.workcell = workcell = find_workcell(task.scene.workcell)
        self._robot = slice(len(workcell.joints))
        self._task, self._rng = task.for_workcell(workcell), np.random.default_rng(seed)
        self.camera: CameraSpec = task.sensing.camera.camera  #: Calibrated lens and pose of the camera.
        self._action_bias = by_joint(workcell, "action_bias", torch.device("cpu"))
        self._world = CatchWorld(task.scene, task.dynamics, num_envs=1, device="cpu", limits_commands=False)
        names = self._world.objects.names
        self._object_ids = torch.tensor([names.index(name) for name in task.objects])
        self._qpos, self._qvel = (self._world.simulation.bind(name)[0].numpy() for name in ("qpos", "qvel"))
        for field in ("jnt_range", "actuator_ctrlrange"):
            for arm in workcell.of_role("arm"):
                self._world.simulation.expand(field)[:, arm] += BEYOND_LIMITS
        self._log: StepExtremes | None = None
        self._steps, self._is_thrown = 0, False
        self.physics_dt, self._decimation = task.scene.physics_dt, task.scene.decimation  # [s]
        self.num_throws = 0
        self.max_joint_speed = 0.0  #: Largest speed of an arm joint so far [rad/s].
        steps = [ENCODER_STEP[each.role] for each in workcell.groups for _ in each.joints]
        self._encoder_step = np.array(steps)
        #: Time by which joints lag in a steady motion [s].
        self.lag: Joints = steady_lag(JointDynamics.of(workcell.joints, task.dynamics))
        self.prepare(seed)
        self._held_from = inf

    @property
    def time(self) -> float:
        """Time since the beginning [s]."""
        return self._steps * self.physics_dt

    @property
    def object_name(self) -> str:
        return self._world.objects.names[int(self.episode.parameters.object_id)]

    @property
    def outcome(self) -> str:
        """Outcome of the throw in a word; its phase until it is over."""
        if self.phase is not Phase.OVER:
            return self.phase
        reached = "reached, not caught" if self.record.is_tracked else "missed"
        return "caught" if self.record.is_success else reached

    @property
    def joints(self) -> JointState:
        """State of the joints as exact encoders would measure it."""
        position = self._qpos[self._robot] + self._encoder_offset
        return JointState(position=position, velocity=self._qvel[self._robot].copy())

    def encoders(self, time: float) -> JointState:
        """Return the measured state at a time up to one physics step from now [s]; call once a cycle.

        The speed until then is extrapolated from the last two physics steps.
        """
        joints, step = self.joints, self._encoder_step
        velocity = 2.0 * joints.velocity - self._velocity_before
        noise = ENCODER_NOISE * self._rng.standard_normal(len(step))
        counts = np.rint((joints.position + (time - self.time) * velocity) / step + noise)
        return JointState(position=step * counts, velocity=velocity)

    def prepare(self, seed: int, *, keeps_robot: bool = False) -> None:
        """Put the robot at the start of a throw, or keep its pose; the object comes after `EMPTY_TIME`.

        It is the throw that `CatchEnv.seed` and `reset` begin in one environment.
        """
        kept = self._qpos[self._robot].copy(), self._qvel[self._robot].copy()
        generator = torch.Generator().manual_seed(seed)
        self.episode: Episode = draw_episode(self._task, self._action_bias, self._object_ids, 1, generator)
        self._world.reset(_YES, self.episode.parameters, self.episode.throw)
        if keeps_robot:
            self._qpos[self._robot], self._qvel[self._robot] = kept
        else:
            self._encoder_offset = self.episode.parameters.joint_bias[0].double().numpy()
        self._world.simulation.forward(_YES)
        self._velocity_before = self._qvel[self._robot].copy()
        release_pos = self.episode.throw.pos[0].double().numpy()
        phase = float(self._rng.uniform(0.0, 2.0 * pi))
        self._thrower = Bystanders(release_pos=release_pos, phase=phase, release=inf)
        self.phase, self._is_thrown = Phase.EMPTY, False
        self.record: EpisodeRecord = self.episode.record  #: Record of the throw, which begins at its release.
        self._held_from = self.time + EMPTY_TIME

    def throw(self) -> None:
        """Release the object at the end of the control step; raise DeploymentError if there is none."""
        if self.phase is not Phase.HELD:
            raise DeploymentError(f"the throw is {self.phase}, not {Phase.HELD}: prepare one, and wait")
        self._is_thrown = True

    def step(self, joint_pos_target: Joints) -> bool:
        """Simulate one physics step with these targets [rad]; return whether it ended a control step."""
        self._velocity_before = self._qvel[self._robot].copy()
        target = torch.from_numpy(joint_pos_target - self._encoder_offset)
        log = self._world.run(target[None], num_steps=1)
        self._log = log if self._log is None else self._log.merged(log)
        self._steps += 1
        if self._steps % self._decimation:
            return False
        self._end_control_step(self._log)
        self._log = None
        return True

    @property
    def _shown_name(self) -> str | None:
        return None if self.phase is Phase.EMPTY else self.object_name

    def exposure(self) -> Exposure:
        moment = Moment(qpos=self._qpos.copy(), qvel=self._qvel.copy(), time=self.time)
        return Exposure(moment=moment, object_name=self._shown_name, thrower=self._thrower.joint_pos)

    def truth(self) -> dict[str, Any]:
        """Return the true state of the throw, for the operator and the report, not for the robot."""
        return {
            "phase": self.phase,
            "throw": self.num_throws,
            "object": self._shown_name,
            "box": self._visible_box(),
            "is_tracked": bool(self.record.is_tracked),
            "is_success": bool(self.record.is_success),
            "joint_speed": self.max_joint_speed,
        }

    def close(self) -> None:
        self._world.simulation.close()

    def _end_control_step(self, log: StepExtremes) -> None:
        self.max_joint_speed = max(self.max_joint_speed, float(log.joint_speed))
        if self.phase is Phase.FLYING:
            self._score(log)
        elif self.phase is Phase.EMPTY and self.time >= self._held_from:
            self.phase = Phase.HELD
        elif self._is_thrown and self.phase is Phase.HELD:
            self._release(log)

    def _score(self, log: StepExtremes) -> None:
        """Count one control step, by the state at its end and the extremes within it."""
        now = self._world.privileged(log)
        none = torch.zeros(1, 0)
        transition = self.record.transition(self._before, now, none, none, self._world.geometry)
        self.record = self.record.advanced(transition, log, self._world.arms, self._world.palms)
        self._before = now
        if int(self.record.steps) >= TRIAL_STEPS or self.record.is_success or is_lost(now):
            self.phase = Phase.OVER

    def _release(self, log: StepExtremes) -> None:
        self._world.release(_YES, self.episode.throw)
        self._world.simulation.forward(_YES)
        self._before = self._world.privileged(log)
        self.record = replace(self.episode.record, steps=self.episode.throw.hover_steps)
        self._thrower = replace(self._thrower, release=self.time)
        self.phase, self.num_throws = Phase.FLYING, self.num_throws + 1

    def _visible_box(self) -> list[float] | None:
        if self.phase is Phase.EMPTY:
            return None
        projection = nominal_projection(self._task.scene.camera, self.record.hold_speed)
        points, is_visible = self._world.surface_points(projection.center)
        box, is_seen = detect(points, is_visible, self._task.sensing.least_visible, projection)
        return box[0].tolist() if is_seen else None
