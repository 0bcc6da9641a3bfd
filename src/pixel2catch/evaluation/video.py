"""Videos of throws: what the robot's camera sees, with the policy's box, and a view from outside."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.envs.step import Step
from pixel2catch.errors import UnknownNameError
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.rendering import OUTSIDE_VIEW, RGB_VIEW, Renderer, VideoWriter, View
from pixel2catch.evaluation.rounds import Actor, RoundState, run_round
from pixel2catch.methods import Method
from pixel2catch.robot.constants import CONTROL_DT
from pixel2catch.robot.scene import SceneCfg, build_model

VIEWS: dict[str, tuple[View, ...]] = {
    "rgb": (RGB_VIEW,),
    "outside": (OUTSIDE_VIEW,),
    "both": (OUTSIDE_VIEW, RGB_VIEW),
}
"""What a picture shows, from left to right."""

BOX_COLOR = (80, 255, 80)
BOX_WIDTH = 2
"""Width of a drawn box's edge [px]."""


@dataclass(frozen=True, kw_only=True)
class Take:
    """One throw, from its start to the decision of the trial.

    Attributes:
        object_name: What was thrown.
        qpos: The state at every control step.
        box: The box that the policy got [px].
    """

    object_name: str
    qpos: Float[ndarray, "num_steps nq"]
    box: Float[ndarray, "num_steps 4"]


def record_takes(cfg: EvaluationCfg, actor: Actor, method: Method) -> list[Take]:
    """Play one round and keep what every environment went through.

    Args:
        cfg: What is thrown; one round of it.
        actor: The policy.
        method: The method that it was trained with.
    """
    env = cfg.make_env(method)
    try:
        return _record_takes(env, actor)
    finally:
        env.close()


def _record_takes(env: CatchEnv, actor: Actor) -> list[Take]:
    """Play a round in these environments."""
    states: list[tuple[Tensor, Tensor, Tensor]] = []
    live = env.world.simulation.bind("qpos")

    def watch(step: Step, state: RoundState) -> None:
        states.append((live.clone().cpu(), step.measurement.box.clone().cpu(), state.is_running.cpu()))

    object_id = run_round(env, actor, watch).record.object_id.tolist()
    takes = []
    for i, row in enumerate(object_id):
        kept = [(qpos[i], box[i]) for qpos, box, is_running in states if is_running[i]]
        qpos, box = zip(*kept, strict=True)
        name = env.world.objects.names[row]
        takes.append(Take(object_name=name, qpos=np.stack(qpos), box=np.stack(box)))
    return takes


def write_video(
    path: Path, takes: Iterable[Take], scene: SceneCfg, view: str = "both", *, shadows: bool = True
) -> int:
    """Draw throws one after the other and return the number of pictures.

    Args:
        path: The file, such as catch.mp4.
        takes: The throws.
        scene: The scene that they were thrown in.
        view: A name out of `VIEWS`.
        shadows: Whether to draw shadows, about 2.5 times slower without a GPU.

    Raises:
        UnknownNameError: If there is no such view.
        DeviceUnavailableError: If nothing can be drawn on this machine; the message says what to install.
    """
    if view not in VIEWS:
        raise UnknownNameError("view", view, VIEWS)
    num_pictures = 0
    with VideoWriter(path, fps=round(1.0 / CONTROL_DT)) as video:
        for take in takes:
            for picture in _pictures(take, scene, VIEWS[view], shadows):
                video.write(picture)
                num_pictures += 1
    return num_pictures


def draw_box(image: UInt8[ndarray, "height width 3"], box: Float[ndarray, "4"]) -> None:
    """Draw the edges of a box (xmin, ymin, xmax, ymax [px]) and a mark in its middle into an image."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = (round(float(value)) for value in box)
    x, y = (x0 + x1) // 2, (y0 + y1) // 2
    e = BOX_WIDTH
    outline = ((x0, y0, x1, y0 + e), (x0, y1 - e, x1, y1), (x0, y0, x0 + e, y1), (x1 - e, y0, x1, y1))
    for left, top, right, bottom in (*outline, (x - e, y - e, x + e, y + e)):
        rows = slice(max(top, 0), min(max(bottom, 0), height))
        columns = slice(max(left, 0), min(max(right, 0), width))
        image[rows, columns] = BOX_COLOR


def _pictures(
    take: Take, scene: SceneCfg, views: tuple[View, ...], shadows: bool
) -> Iterator[UInt8[ndarray, "height width 3"]]:
    """Pictures of one throw, the views side by side."""
    model = build_model(replace(scene, visuals=True), take.object_name)
    renderers = [Renderer(model, view, shadows=shadows) for view in views]
    try:
        for qpos, box in zip(take.qpos, take.box, strict=True):
            images = [renderer.image(qpos) for renderer in renderers]
            for view, image in zip(views, images, strict=True):
                if view is RGB_VIEW:
                    draw_box(image, box)
            yield np.concatenate(images, axis=1)
    finally:
        for renderer in renderers:
            renderer.close()
