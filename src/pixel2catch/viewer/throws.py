"""Throws one by one, in one environment, as the page asks for them; each can be looked at again."""

from collections.abc import Iterator
from dataclasses import dataclass
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
from pixel2catch.mdp.throws import flight_path
from pixel2catch.methods import Method
from pixel2catch.policy import LoadedPolicy
from pixel2catch.rendering.camera import Exposure, Moment
from pixel2catch.rendering.room import Bystanders
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.objects import select_objects
from pixel2catch.shipped import policy_folder
from pixel2catch.viewer.disturbances import Setting, disturbed, released_at
from pixel2catch.viewer.scene import Path as FlightPath


@dataclass(frozen=True, kw_only=True)
class ThrowOrder:
    """What the next throw shall be like; throws of equal orders are counted together."""

    policy: str  #: Folder or name of the policy.
    objects: str  #: What is thrown, as `select_objects` takes it, separated by commas.
    settings: tuple[Setting, ...]  #: Of each of `DISTURBANCES`.
    release_pos: tuple[float, float, float] | None = None  #: Where it is released [m]; drawn if none.


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What there is to show of one control step."""

    exposure: Exposure  #: Robot, object and thrower; its time is that since the release [s].
    box: Float[np.ndarray, "4"]  #: The box that the policy gets [px].
    pixel_features: Float[np.ndarray, "8"]  #: What it makes of it, in the order of `PIXEL_FEATURES`.
    joint_pos: Float[np.ndarray, " num_joints"]  #: What the encoders say [rad].
    joint_pos_target: Float[np.ndarray, " num_joints"]  #: What was commanded [rad].

    @property
    def time(self) -> float:
        """Time since the release [s]."""
        return self.exposure.moment.time

    @property
    def object_pos(self) -> Float[np.ndarray, "3"]:
        """Where the object is [m]."""
        return self.exposure.moment.qpos[-7:-4]


@dataclass(frozen=True, kw_only=True)
class PlayedThrow:
    """A throw that is over."""

    number: int  #: It counts from 1.
    order: ThrowOrder  #: What it was to be like.
    object_name: str  #: What was thrown.
    path: FlightPath  #: Where the object would fly, untouched, evenly over its time [m].
    flight_time: float  #: That time [s].
    frames: tuple[Frame, ...]  #: All its control steps.
    is_success: bool  #: Whether it was caught, by the paper's rule.
    outcome: str  #: How it ended, in words.


class Thrower:
    """Throws what was ordered, and has an environment for as long as orders are equal."""

    def __init__(self, dynamics: Path | None = None, camera: Path | None = None) -> None:
        """Nothing is loaded before the first order; files are as of `task_of`."""
        self._dynamics, self._camera = dynamics, camera
        self._policies: dict[str, tuple[LoadedPolicy, Method]] = {}
        self._written: dict[str, float] = {}
        self._env: CatchEnv | None = None
        self._order: ThrowOrder | None = None
        self.num_throws = 0  #: Throws so far.
        self.num_renewed = 0  #: How often a policy was read that a training had changed.

    def task(self, policy: str) -> CatchEnvCfg:
        """The undisturbed task of a policy."""
        return task_of(self._loaded(policy)[0], dynamics=self._dynamics, camera=self._camera)

    def throw(self, order: ThrowOrder, seed: int) -> "Throwing":
        """Begin a throw.

        Raises:
            Pixel2CatchError: If there is no such policy or object, or a file does not fit.
        """
        policy, method = self._loaded(order.policy)
        if self._env is None or order != self._order:
            self.close()
            task = disturbed(self.task(order.policy), order.settings)
            if order.release_pos is not None:
                task = released_at(task, order.release_pos)
            objects = select_objects(order.objects)
            cfg = EvaluationCfg(objects=objects, num_envs=1, seed=seed, task=task)
            self._env, self._order = cfg.make_env(method), order
        self._env.seed(seed)
        self.num_throws += 1
        return Throwing(self._env, policy, order, self.num_throws)

    def close(self) -> None:
        """Free the environment."""
        if self._env is not None:
            self._env.close()
        self._env = None

    def _loaded(self, policy: str) -> tuple[LoadedPolicy, Method]:
        """The policy; read again when a training has written a newer one."""
        file = policy_folder(Path(policy)) / "policy.safetensors"
        written = file.stat().st_mtime if file.exists() else 0.0
        if self._written.get(policy) != written:
            self.num_renewed += policy in self._written
            self._policies[policy] = load_policy(Path(policy))
            self._written[policy] = written
        return self._policies[policy]


class Throwing:
    """A throw that goes on."""

    def __init__(self, env: CatchEnv, policy: LoadedPolicy, order: ThrowOrder, number: int) -> None:
        """Nothing happens before the first of `frames`."""
        self._env, self._policy, self.order, self.number = env, policy, order, number
        self._camera = env.cfg.sensing.camera.camera
        self.frames: list[Frame] = []  #: What happened so far.
        self.object_name = ""  #: What is thrown.
        self.path: FlightPath = np.zeros((1, 3))  #: Where the object would fly, untouched [m].
        self.flight_time = 0.0  #: How long [s].
        self._state: RoundState | None = None

    def run(self) -> Iterator[Frame]:
        """Every control step until the throw is decided and a hold is tested."""
        simulation = self._env.world.simulation
        qpos, qvel = (simulation.bind(name)[0].numpy() for name in ("qpos", "qvel"))
        bystanders: Bystanders | None = None
        release, box = 0, torch.zeros(1, 4)
        for step, state in round_steps(self._env, self._policy):
            episode = self._env.episode
            if bystanders is None:
                self.object_name = self._env.world.objects.names[int(episode.parameters.object_id)]
                self.path, release = _flight(episode), int(episode.throw.hover_steps)
                self.flight_time = float(episode.throw.flight_time())
                bystanders = Bystanders(
                    release_pos=episode.throw.pos[0].double().numpy(), phase=float(self.number)
                )
                box = step.measurement.box.clone()
            self._state = state
            if not state.is_running[0]:
                return
            time = CONTROL_DT * (len(self.frames) + 1 - release)
            moment = Moment(qpos=qpos.astype(float), qvel=qvel.astype(float), time=time)
            exposure = Exposure(moment=moment, object_name=self.object_name, thrower=bystanders.joint_pos)
            self.frames.append(self._frame(step, exposure, box))
            box = step.measurement.box.clone()
            yield self.frames[-1]

    def played(self) -> PlayedThrow:
        """The throw, which is over."""
        assert self._state is not None
        record = self._state.record
        is_success = bool(record.is_success)
        caught = "caught and held" if bool(self._state.is_verified) else "caught, not held"
        return PlayedThrow(
            number=self.number,
            order=self.order,
            object_name=self.object_name,
            path=self.path,
            flight_time=self.flight_time,
            frames=tuple(self.frames),
            is_success=is_success,
            outcome=caught if is_success else FAILURES[int(failure(record))].replace("_", " "),
        )

    def _frame(self, step: Step, exposure: Exposure, box_before: torch.Tensor) -> Frame:
        measured = step.measurement
        return Frame(
            exposure=exposure,
            box=measured.box[0].numpy().copy(),
            pixel_features=pixel_features(box_before, measured.box, self._camera)[0].numpy(),
            joint_pos=measured.joint_pos[0].numpy().copy(),
            joint_pos_target=step.joint_pos_target[0].numpy().copy(),
        )


def _flight(episode: Episode) -> FlightPath:
    """Where the object of the only environment flies to the height it is aimed at."""
    throw = episode.throw
    drag = torch.zeros(1) if episode.drag is None else episode.drag
    path = flight_path(throw.pos, throw.lin_vel, drag, throw.flight_time())
    return path[:, 0].double().numpy()
