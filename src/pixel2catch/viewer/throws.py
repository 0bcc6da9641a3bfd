"""Throws one by one in one environment, with disturbances; each can be shown again."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.episode import FAILURES, Episode, failure
from pixel2catch.evaluation.loading import load_policy, task_of
from pixel2catch.evaluation.protocol import EvaluationCfg, round_steps
from pixel2catch.evaluation.stress import select_settings
from pixel2catch.mdp.throws import flight_path
from pixel2catch.methods import Method
from pixel2catch.policy import Policy
from pixel2catch.rendering.camera import Exposure, Moment
from pixel2catch.rendering.room import Bystanders
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.objects import select_objects
from pixel2catch.viewer.scene import FlightPath


@dataclass(frozen=True, kw_only=True)
class ThrowOrder:
    """Settings of a throw; throws of equal settings are counted together."""

    policy: str  #: Folder or name of the policy.
    objects: str  #: What is thrown, names of `select_objects` separated by commas.
    disturbance: str = "nominal"  #: Title of a setting of `pixel2catch stress`.


@dataclass(frozen=True, kw_only=True)
class ThrowStep:
    """What the page shows of one control step."""

    exposure: Exposure  #: Robot, object and thrower; the time is since the release [s].
    box: Float[np.ndarray, "4"]  #: The box that the policy gets [px].


@dataclass(kw_only=True)
class PlayedThrow:
    """A throw; `ThrowPlayer.run` adds its control steps one by one, and its outcome at the end."""

    number: int  #: Number of the throw, from 1.
    order: ThrowOrder  #: Its settings.
    object_name: str = ""  #: What is thrown.
    path: FlightPath = field(default_factory=lambda: np.zeros((1, 3)))  #: Path without contact [m].
    steps: list[ThrowStep] = field(default_factory=list)  #: Its control steps so far.
    is_success: bool = False  #: Whether it was caught, by the paper's rule.
    outcome: str = ""  #: Outcome in words; empty until it is decided.


class ThrowPlayer:
    """Simulates throws; keeps the environment while the settings stay equal."""

    def __init__(self, dynamics: Path | None = None, camera: Path | None = None) -> None:
        """Load nothing yet; dynamics and camera files are those of `task_of`."""
        self._dynamics, self._camera = dynamics, camera
        self._loaded: Callable[[str], tuple[Policy, Method]] = cache(lambda name: load_policy(Path(name)))
        self._running: tuple[CatchEnv, ThrowOrder] | None = None
        self.num_throws = 0  #: Throws so far.

    def task(self, order: ThrowOrder) -> CatchEnvCfg:
        """Return the disturbed task of a policy."""
        (setting,) = (each for each in select_settings(()) if each.title == order.disturbance)
        policy, _ = self._loaded(order.policy)
        return setting.level.change(task_of(policy, dynamics=self._dynamics, camera=self._camera))

    def run(self, order: ThrowOrder, seed: int) -> Iterator[PlayedThrow]:
        """Yield a throw after each of its control steps; it has its outcome when the iteration has ended."""
        policy, method = self._loaded(order.policy)
        env = self._environment(order, method, seed)
        env.seed(seed)
        self.num_throws += 1
        throw = PlayedThrow(number=self.num_throws, order=order)
        qpos, qvel = (env.world.simulation.bind(name)[0].numpy() for name in ("qpos", "qvel"))
        observation, episode, last = env.reset(), env.episode, None
        throw.object_name = env.world.objects.names[int(episode.parameters.object_id)]
        throw.path, release = _flight(episode), int(episode.throw.hover_steps)
        release_pos = episode.throw.pos[0].double().numpy()
        bystanders = Bystanders(release_pos=release_pos, phase=float(throw.number))
        for step, last in round_steps(env, policy, observation):
            if not last.is_running[0]:
                break
            time = CONTROL_DT * (len(throw.steps) + 1 - release)
            moment = Moment(qpos=qpos.astype(float), qvel=qvel.astype(float), time=time)
            exposure = Exposure(moment=moment, object_name=throw.object_name, thrower=bystanders.joint_pos)
            throw.steps.append(ThrowStep(exposure=exposure, box=step.measurement.box[0].numpy().copy()))
            yield throw
        if last is not None:
            throw.is_success = bool(last.record.is_success)
            caught = "caught and held" if bool(last.is_verified) else "caught, not held"
            missed = FAILURES[int(failure(last.record))].replace("_", " ")
            throw.outcome = caught if throw.is_success else missed

    def close(self) -> None:
        if self._running is not None:
            self._running[0].close()
        self._running = None

    def _environment(self, order: ThrowOrder, method: Method, seed: int) -> CatchEnv:
        if self._running is None or order != self._running[1]:
            self.close()
            objects = select_objects(order.objects)
            cfg = EvaluationCfg(objects=objects, num_envs=1, seed=seed, task=self.task(order))
            self._running = cfg.make_env(method), order
        return self._running[0]


def _flight(episode: Episode) -> FlightPath:
    """Return the path of the object of the only environment up to the aimed height."""
    throw = episode.throw
    drag = torch.zeros(1) if episode.drag is None else episode.drag
    return flight_path(throw.pos, throw.lin_vel, drag, throw.flight_time())[:, 0].double().numpy()
