"""Simulated throws as a data set: measurements, commands, rewards and success."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np
import torch
from torch import Tensor

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.camera.image import Pixels
from pixel2catch.datasets.lerobot import (
    ACTION,
    AGE,
    DONE,
    REWARD,
    SEEN,
    STATE,
    SUCCESS,
    Episode,
    write_dataset,
)
from pixel2catch.envs.catch_env import CatchEnv, Step
from pixel2catch.evaluation.protocol import Actor, EvaluationCfg, RoundState, run_round
from pixel2catch.files import require_free_folder
from pixel2catch.methods import Method
from pixel2catch.rendering.renderer import RGB_VIEW, Renderer
from pixel2catch.scene.constants import RGB_CAMERA
from pixel2catch.scene.scene import SceneCfg, build_model


@final
class _Recorder:
    """An actor that records what it observes, and the steps that its actions lead to."""

    def __init__(self, actor: Actor, env: CatchEnv) -> None:
        self._env, self._act, self.reset = env, actor.act, actor.reset
        self._qpos = env.world.simulation.bind("qpos")
        self.rows = list[list[Tensor]]()  #: What `columns` names, for each control step.

    def act(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        now = self._env.measurement
        self._seen = [each.cpu().clone() for each in (self._qpos, now.joint_pos, now.box, now.boxes.age)]
        return self._act(observations)

    def watch(self, step: Step, state: RoundState) -> None:
        rewards = torch.stack([*step.rewards.values()]).sum(dim=0)
        made = (step.joint_pos_target, rewards, state.is_running & ~state.is_testing)
        self.rows.append([*self._seen, *(each.cpu().clone() for each in made)])

    def columns(self, row: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return positions of the simulation, (num_steps, nq), and features of a throw until its decision."""
        qpos, joints, box, age, targets, rewards, is_open = (
            torch.stack(each)[:, row] for each in zip(*self.rows, strict=True)
        )
        count = int(is_open.sum()) + 1  # the last one is that of the decision
        pixels = pixel_features(torch.cat((box[:1], box[:-1])), box, RGB_CAMERA)
        features = {
            STATE: joints,
            SEEN: torch.cat((box, pixels), dim=1),
            AGE: age[:, :1],
            ACTION: targets,
            REWARD: rewards,
            DONE: torch.arange(len(box)) == count - 1,
        }
        return qpos[:count].numpy(), {name: each[:count].numpy() for name, each in features.items()}


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
        recorder = _Recorder(actor, env)
        record = run_round(env, recorder, recorder.watch).record
        names = [env.world.objects.names[row] for row in record.object_id.tolist()]
    finally:
        env.close()

    def episode(row: int, name: str) -> Episode:
        qpos, features = recorder.columns(row)
        features[SUCCESS] = features[DONE] & bool(record.is_success[row])
        pictures = _pictures(qpos, cfg.task.scene, name) if images else ()
        return f"Catch the thrown object: {name}.", features, pictures

    episodes = (episode(row, name) for row, name in enumerate(names))
    num_throws, num_steps = write_dataset(folder, env.workcell, episodes)
    return num_throws, int(record.is_success.sum()), num_steps


def _pictures(qpos: np.ndarray, scene: SceneCfg, object_name: str) -> Iterator[Pixels]:
    """Yield the images of the robot's camera at positions of the simulation, (num_steps, nq)."""
    with Renderer(build_model(replace(scene, visuals=True), object_name), RGB_VIEW) as renderer:
        for positions in qpos:
            yield renderer.image(positions)
