"""Simulated throws as a data set: measurements, commands, rewards and success."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import final

import numpy as np
import torch
from torch import Tensor

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.camera.image import Pixels
from pixel2catch.datasets.lerobot import ACTION, AGE, DONE, REWARD, SEEN, STATE, SUCCESS, Step, write_dataset
from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.catch_env import Step as EnvStep
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, RoundState, run_round
from pixel2catch.files import require_free_folder
from pixel2catch.mdp.control_step import Measurement
from pixel2catch.mdp.tensors import clone
from pixel2catch.methods import Method
from pixel2catch.rendering.renderer import RGB_VIEW, Renderer
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg, build_model


@dataclass(frozen=True, kw_only=True, eq=False)
class _Moment:
    """A control step of all environments."""

    features: dict[str, Tensor]  #: (num_envs, size) by feature.
    qpos: Tensor  #: Positions of the simulation before it, (num_envs, nq).
    is_thrown: Tensor  #: Whether the trial of the environment was still undecided, (num_envs,).


@final
class _Watcher:
    """An actor that records what it observes, its actions and their rewards."""

    def __init__(self, actor: Actor, env: CatchEnv) -> None:
        self._actor, self._env = actor, env
        self._qpos = env.world.simulation.bind("qpos")
        self._is_thrown = torch.ones(env.num_envs, dtype=torch.bool)
        self._before: Measurement | None = None
        self.moments = list[_Moment]()

    def reset(self, is_ended: Tensor | None = None) -> None:
        self._actor.reset(is_ended)

    def act(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        now = clone(self._env.measurement)
        before = self._before or now
        pixels = pixel_features(before.box, now.box, RGB_CAMERA)
        self._before, self._qpos_now = now, self._qpos.cpu().clone()
        self._seen = {
            STATE: now.joint_pos,
            SEEN: torch.cat((now.box, pixels), dim=-1),
            AGE: now.boxes.age[:, :1],
        }
        return self._actor.act(observations)

    def watch(self, step: EnvStep, state: RoundState) -> None:
        """Record a step."""
        rewards = torch.stack([*step.rewards.values()]).sum(dim=0)
        made = {ACTION: step.joint_pos_target, REWARD: rewards[:, None]}
        features = {name: value.cpu().clone() for name, value in (self._seen | made).items()}
        self.moments.append(_Moment(features=features, qpos=self._qpos_now, is_thrown=self._is_thrown))
        self._is_thrown = (state.is_running & ~state.is_testing).cpu().clone()


def write_throws(
    folder: Path, cfg: EvaluationCfg, actor: Actor, method: Method, *, images: bool
) -> tuple[int, int, int]:
    """Throw once in every environment, and write every trial until its decision.

    With `images`, the images of the robot's camera at the decisions are drawn, without latency.

    Returns:
        The number of throws, of catches, and of control steps.

    Raises:
        DeviceUnavailableError: Images cannot be drawn on this machine.
    """
    require_free_folder(folder)
    env = cfg.make_env(method)
    try:
        watcher = _Watcher(actor, env)
        record = run_round(env, watcher, watcher.watch).record
        names = [env.world.objects.names[row] for row in record.object_id.tolist()]
    finally:
        env.close()

    def steps(row: int) -> Iterator[Step]:
        moments = [moment for moment in watcher.moments if moment.is_thrown[row]]
        pictures = _pictures([moment.qpos[row].numpy() for moment in moments], cfg.task.scene, names[row])
        for moment, picture in zip(moments, pictures if images else repeat(None), strict=False):
            is_last = moment is moments[-1]
            ends = {DONE: is_last, SUCCESS: is_last and bool(record.is_success[row])}
            yield {key: value[row].numpy() for key, value in moment.features.items()} | ends, picture

    episodes = ((f"Catch the thrown object: {name}.", steps(row)) for row, name in enumerate(names))
    num_throws, num_steps = write_dataset(folder, env.workcell, episodes)
    return num_throws, int(record.is_success.sum()), num_steps


def _pictures(qpos: list[np.ndarray], scene: SceneCfg, object_name: str) -> Iterator[Pixels]:
    """Yield the images of the robot's camera at positions of the simulation, (nq,) each."""
    with Renderer(build_model(replace(scene, visuals=True), object_name), RGB_VIEW) as renderer:
        for positions in qpos:
            yield renderer.image(positions)
