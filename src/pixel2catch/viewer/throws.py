"""Throws one by one in one environment, with disturbances; each can be shown again."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import radians
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.envs.catch_env import CatchEnv, Step
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.episode import FAILURES, Episode, failure
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, RoundState, round_steps
from pixel2catch.evaluation.stress.suite import part
from pixel2catch.mdp.throws import flight_path
from pixel2catch.methods import Method
from pixel2catch.policy import LoadedPolicy
from pixel2catch.rendering.camera import Exposure, Moment
from pixel2catch.rendering.room import Bystanders
from pixel2catch.scene.constants import CONTROL_DT, CameraSpec
from pixel2catch.scene.objects import select_objects
from pixel2catch.shipped import policy_folder
from pixel2catch.viewer.scene import FlightPath

Setting = float | tuple[float, float]  #: A number, or the range from which every throw draws its own.


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """A field of the task and its slider."""

    label: str  #: Text of the slider, with the unit.
    part: str  #: Part of the task, such as `sensing`.
    name: str  #: Field of that part: a number or a range.
    largest: float  #: Largest value, in the unit of the label; the least is 0.
    step: float  #: Step of the slider, in that unit.
    scale: float  #: The field's unit over the label's.
    #: Field with the grid of the drawn values, which is set to the step; none if empty.
    grid: str

    def of(self, task: CatchEnvCfg) -> Setting:
        """Return the setting of a task, in the unit of the label."""
        value = getattr(getattr(task, self.part), self.name)
        return tuple(each / self.scale for each in value) if isinstance(value, tuple) else value / self.scale

    def applied(self, task: CatchEnvCfg, setting: Setting) -> CatchEnvCfg:
        """Return the task with a setting in the unit of the label; the task itself if it has that setting."""
        if setting == self.of(task):
            return task
        value = (
            tuple(each * self.scale for each in setting)
            if isinstance(setting, tuple)
            else setting * self.scale
        )
        grid = {self.grid: self.step} if self.grid else {}
        return part(self.part, **{self.name: value}, **grid)(task)


HINTS = {
    "latency [steps]": "Control steps of 33 ms between an image and its box; every throw draws its own.",
    "box noise [px]": "Largest error of each edge of the box.",
    "missing boxes [%]": "Share of the images in which the object is not found.",
    "camera turned [°]": "Angle between the camera and the one that the policy assumes.",
    "camera moved [cm]": "Distance between the camera and the one that the policy assumes.",
    "command delay [steps]": "Control steps between a command and its effect; every throw draws its own.",
    "restitution": "Speed after an impact over the speed before; every throw draws its own.",
    "drag: air [kg/m³]": "Density of the air that slows the object; real air has 1.2. "
    "The thrower throws harder to reach the same point.",
}
"""Hint of each slider."""

DISTURBANCES = tuple(
    Disturbance(label=label, part=part, name=name, largest=largest, step=step, scale=scale, grid=grid)
    for label, part, name, largest, step, scale, grid in (
        ("latency [steps]", "sensing", "latency_steps", 5.0, 0.5, 1.0, "latency_grid"),
        ("box noise [px]", "sensing", "corner_noise", 20.0, 1.0, 1.0, ""),
        ("missing boxes [%]", "sensing", "drop_rate", 60.0, 5.0, 1e-2, ""),
        ("camera turned [°]", "sensing", "camera_turn", 4.0, 0.25, radians(1.0), ""),
        ("camera moved [cm]", "sensing", "camera_offset", 8.0, 0.5, 1e-2, ""),
        ("command delay [steps]", "randomization", "command_delay", 3.0, 0.5, 1.0, "command_delay_grid"),
        ("restitution", "randomization", "restitution", 0.8, 0.05, 1.0, ""),
        ("drag: air [kg/m³]", "randomization", "air_density", 3.6, 0.1, 1.0, ""),
    )
)


def disturbed(task: CatchEnvCfg, settings: tuple[Setting, ...]) -> CatchEnvCfg:
    """Return the task with a setting for each of `DISTURBANCES`."""
    for disturbance, setting in zip(DISTURBANCES, settings, strict=True):
        task = disturbance.applied(task, setting)
    return task


def released_at(task: CatchEnvCfg, pos: tuple[float, float, float]) -> CatchEnvCfg:
    """Return the task with one release point for all throws [m]; the aims stay."""
    x, y, z = pos
    throws = replace(task.throws, release_x=(x, x), release_y=(y, y), release_z=(z, z))
    return replace(task, throws=throws)


@dataclass(frozen=True, kw_only=True)
class ThrowOrder:
    """Settings of a throw; throws of equal settings are counted together."""

    policy: str  #: Folder or name of the policy.
    objects: str  #: What is thrown, names of `select_objects` separated by commas.
    settings: tuple[Setting, ...]  #: Of each of `DISTURBANCES`.
    release_pos: tuple[float, float, float] | None = None  #: Release point [m]; drawn if none.


@dataclass(frozen=True, kw_only=True)
class ThrowStep:
    """What the page shows of one control step."""

    exposure: Exposure  #: Robot, object and thrower; the time is since the release [s].
    box: Float[np.ndarray, "4"]  #: The box that the policy gets [px].
    pixel_features: Float[np.ndarray, "8"]  #: Features of that box, in the order of `PIXEL_FEATURES`.
    joint_pos_target: Float[np.ndarray, " num_joints"]  #: Commanded positions [rad].

    @property
    def time(self) -> float:
        """Time since the release [s]."""
        return self.exposure.moment.time

    @property
    def object_pos(self) -> Float[np.ndarray, "3"]:
        """Position of the object [m]."""
        return self.exposure.moment.qpos[-7:-4]


@dataclass(kw_only=True)
class PlayedThrow:
    """A throw; `ThrowPlayer.run` adds its control steps one by one, and its outcome at the end."""

    number: int  #: Number of the throw, from 1.
    order: ThrowOrder  #: Its settings.
    object_name: str = ""  #: What is thrown.
    path: FlightPath = field(default_factory=lambda: np.zeros((1, 3)))  #: Path without contact [m].
    flight_time: float = 0.0  #: Duration of that path [s].
    frames: list[ThrowStep] = field(default_factory=list)  #: Its control steps so far.
    is_success: bool = False  #: Whether it was caught, by the paper's rule.
    outcome: str = ""  #: Outcome in words; empty until it is decided.


class ThrowPlayer:
    """Simulates throws; keeps the environment while the settings stay equal."""

    def __init__(self, dynamics: Path | None = None, camera: Path | None = None) -> None:
        """Load nothing yet; dynamics and camera files are those of `task_of`."""
        self._dynamics, self._camera = dynamics, camera
        self._policies: dict[str, tuple[LoadedPolicy, Method]] = {}
        self._written: dict[str, float] = {}
        self._running: tuple[CatchEnv, ThrowOrder] | None = None
        self.num_throws = 0  #: Throws so far.
        self.num_renewed = 0  #: Number of times that a policy was read again because a training changed it.

    def task(self, policy: str) -> CatchEnvCfg:
        """Return the undisturbed task of a policy."""
        return task_of(self._loaded(policy)[0], dynamics=self._dynamics, camera=self._camera)

    def run(self, order: ThrowOrder, seed: int) -> Iterator[PlayedThrow]:
        """Yield a throw after each of its control steps; it has its outcome when the iteration has ended.

        Raises:
            Pixel2CatchError: There is no such policy or object, or a file does not fit.
        """
        policy, method = self._loaded(order.policy)
        env = self._environment(order, method, seed)
        env.seed(seed)
        self.num_throws += 1
        throw = PlayedThrow(number=self.num_throws, order=order)
        qpos, qvel = (env.world.simulation.bind(name)[0].numpy() for name in ("qpos", "qvel"))
        bystanders, last = None, None
        release, box = 0, torch.zeros(1, 4)
        for step, last in round_steps(env, policy):
            if bystanders is None:
                episode = env.episode
                throw.object_name = env.world.objects.names[int(episode.parameters.object_id)]
                throw.path, release = _flight(episode), int(episode.throw.hover_steps)
                throw.flight_time = float(episode.throw.flight_time())
                release_pos = episode.throw.pos[0].double().numpy()
                bystanders = Bystanders(release_pos=release_pos, phase=float(throw.number))
                box = step.measurement.box.clone()
            if not last.is_running[0]:
                break
            time = CONTROL_DT * (len(throw.frames) + 1 - release)
            moment = Moment(qpos=qpos.astype(float), qvel=qvel.astype(float), time=time)
            name, thrower = throw.object_name, bystanders.joint_pos
            exposure = Exposure(moment=moment, object_name=name, thrower=thrower)
            throw.frames.append(_frame(step, exposure, box, env.cfg.sensing.camera.camera))
            box = step.measurement.box.clone()
            yield throw
        if last is not None:
            _decide(throw, last)

    def close(self) -> None:
        """Free the environment."""
        if self._running is not None:
            self._running[0].close()
        self._running = None

    def _environment(self, order: ThrowOrder, method: Method, seed: int) -> CatchEnv:
        if self._running is None or order != self._running[1]:
            self.close()
            task = disturbed(self.task(order.policy), order.settings)
            if order.release_pos is not None:
                task = released_at(task, order.release_pos)
            objects = select_objects(order.objects)
            cfg = EvaluationCfg(objects=objects, num_envs=1, seed=seed, task=task)
            self._running = cfg.make_env(method), order
        return self._running[0]

    def _loaded(self, policy: str) -> tuple[LoadedPolicy, Method]:
        """Return the policy; read it again if its file is newer."""
        file = policy_folder(Path(policy)) / "policy.safetensors"
        written = file.stat().st_mtime if file.exists() else 0.0
        if self._written.get(policy) != written:
            self.num_renewed += policy in self._written
            self._policies[policy] = load_policy(Path(policy))
            self._written[policy] = written
        return self._policies[policy]


def _decide(throw: PlayedThrow, state: RoundState) -> None:
    """Set the outcome of a throw."""
    throw.is_success = bool(state.record.is_success)
    if throw.is_success:
        throw.outcome = "caught and held" if bool(state.is_verified) else "caught, not held"
    else:
        throw.outcome = FAILURES[int(failure(state.record))].replace("_", " ")


def _frame(step: Step, exposure: Exposure, box_before: torch.Tensor, camera: CameraSpec) -> ThrowStep:
    measured = step.measurement
    return ThrowStep(
        exposure=exposure,
        box=measured.box[0].numpy().copy(),
        pixel_features=pixel_features(box_before, measured.box, camera)[0].numpy(),
        joint_pos_target=step.joint_pos_target[0].numpy().copy(),
    )


def _flight(episode: Episode) -> FlightPath:
    """Return the path of the object of the only environment up to the aimed height."""
    throw = episode.throw
    drag = torch.zeros(1) if episode.drag is None else episode.drag
    path = flight_path(throw.pos, throw.lin_vel, drag, throw.flight_time())
    return path[:, 0].double().numpy()
