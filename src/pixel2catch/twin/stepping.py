"""Rehearsals in step: with rendered images, or with images of nothing but the object's box."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.deployment.brain import Brain, make_brain
from pixel2catch.deployment.controller import Controller
from pixel2catch.deployment.limits import ServoLimits
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.color import ColorRange, ColorThreshold
from pixel2catch.perception.factory import make_robot_mask
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Image, Segmenter
from pixel2catch.policy import Policy
from pixel2catch.rendering.camera import Exposure, RoomCamera
from pixel2catch.twin.lab import Lab
from pixel2catch.twin.lockstep import PERCEPTION_TIME, Draw, Lockstep, LockstepCfg
from pixel2catch.twin.trials import Outcome, of_twin, rates, run_trial

GREY, RED, RED_HUES = 120, (200, 30, 20), ColorRange(hue=(340.0, 20.0))
"""Colours of plain images."""


@dataclass(frozen=True, kw_only=True)
class SteppingCfg:
    """What is rehearsed in step.

    Attributes:
        task: What is thrown at which robot.
        throws: How many throws.
        seed: Of the first throw; the next has the next.
        perception_time: Least time that perception takes for an image [s].
        perception_jitter: How much more it may be, drawn for each image [s].
        clock_error: How much older images are by their stamps than they are [s]; negative: younger.
        is_plain: Whether the camera shows nothing but the object's box, so that perception cannot fail.
        limits: What the servo keeps to.
        record: New folder for the recording of the deployment; none for no recording.
    """

    task: CatchEnvCfg
    throws: int
    seed: int = 0
    perception_time: float = PERCEPTION_TIME
    perception_jitter: float = 0.0
    clock_error: float = 0.0
    is_plain: bool = False
    limits: ServoLimits = field(default_factory=ServoLimits)
    record: Path | None = None


def rehearse_in_step(cfg: SteppingCfg, policy: Policy, report: Callable[[Outcome], None]) -> dict[str, Any]:
    """Throw, and count.

    Args:
        cfg: What is rehearsed.
        policy: What catches.
        report: Called after every throw.

    Returns:
        The report, for programs.

    Raises:
        DeviceUnavailableError: If images are to be drawn, and no OpenGL back end works.
        PolicyMismatchError: The policy cannot be deployed.
    """
    outcomes: list[Outcome] = []
    with in_step(cfg, policy) as lockstep:
        for seed in range(cfg.seed, cfg.seed + cfg.throws):
            outcomes.append(run_trial(lockstep.operator, seed))
            report(outcomes[-1])
        return {
            **rates(outcomes),
            "perception_time": cfg.perception_time,
            "perception_jitter": cfg.perception_jitter,
            "clock_error": cfg.clock_error,
            "deploy": lockstep.deployment.diary.summary(),
            "twin": of_twin(lockstep.operator.truth),
        }


@contextmanager
def in_step(cfg: SteppingCfg, policy: Policy) -> Iterator[Lockstep]:
    """Twin and deployment of a rehearsal, before the first throw.

    Args:
        cfg: What is rehearsed.
        policy: What catches.
    """
    with ExitStack() as stack:
        draw, brain = _plain(cfg, policy) if cfg.is_plain else _rendered(cfg, policy, stack)
        world = LockstepCfg(
            task=cfg.task,
            limits=cfg.limits,
            seed=cfg.seed,
            perception_time=cfg.perception_time,
            perception_jitter=cfg.perception_jitter,
            clock_error=cfg.clock_error,
            record=cfg.record,
        )
        yield stack.enter_context(Lockstep(world, draw, brain))


def _rendered(cfg: SteppingCfg, policy: Policy, stack: ExitStack) -> tuple[Draw, Brain]:
    """What `pixel2catch twin` shows, and what `pixel2catch deploy` sees in it."""
    scene = cfg.task.scene
    view = stack.enter_context(RoomCamera(scene, cfg.seed))
    robot = make_robot_mask(scene.camera, scene.handedness)
    return lambda _, exposure: view.image(exposure), _brain(cfg, policy, BackgroundSubtraction(), robot)


def _plain(cfg: SteppingCfg, policy: Policy) -> tuple[Draw, Brain]:
    """Red boxes, and eyes for red."""
    return plain_image, _brain(cfg, policy, ColorThreshold(RED_HUES), None)


def _brain(cfg: SteppingCfg, policy: Policy, segmenter: Segmenter, robot: RobotMask | None) -> Brain:
    """What catches."""
    scene = cfg.task.scene
    controller = Controller(policy, scene.handedness, scene.camera)
    return make_brain(controller, segmenter, Prompter(), scene.camera, robot)


def plain_image(lab: Lab, _: Exposure) -> Image:
    """A grey image with a red box where the camera would see the object."""
    camera = lab.camera
    image = np.full((camera.height, camera.width, 3), GREY, dtype=np.uint8)
    if box := lab.truth()["box"]:
        xmin, ymin, xmax, ymax = map(round, box)
        image[ymin:ymax, xmin:xmax] = RED
    return image
