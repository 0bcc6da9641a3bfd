"""Rehearsals in step: with rendered images, or with images of nothing but the object's box."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.deployment.brain import Brain, make_brain
from pixel2catch.deployment.clock import Clock
from pixel2catch.deployment.controller import Controller
from pixel2catch.deployment.limits import ServoLimits
from pixel2catch.deployment.stepwise import MakeBrain, SlowSegmenter
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.perception.choice import PromptCfg, SegmenterCfg, make_prompter, make_segmenter
from pixel2catch.perception.color import ColorRange
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Image
from pixel2catch.policy import Policy
from pixel2catch.twin.lab import Lab
from pixel2catch.twin.lockstep import Draw, Lockstep, LockstepCfg
from pixel2catch.twin.trials import Outcome, of_twin, rates, run_trial
from pixel2catch.twin.view import Exposure, RoomView

PERCEPTION_TIME = 0.010
"""Time that perception takes for an image [s]. Source: ours, background subtraction on one core."""

GREY, RED, RED_HUES = 120, (200, 30, 20), ColorRange(hue=(340.0, 20.0))
"""Colours of plain images."""


@dataclass(frozen=True, kw_only=True)
class SteppingCfg:
    """What is rehearsed in step.

    Attributes:
        task: What is thrown at which robot.
        throws: How many throws.
        seed: Of the first throw; the next has the next.
        perception_time: Time that perception takes for an image [s].
        is_plain: Whether the camera shows nothing but the object's box, so that perception cannot fail.
        limits: What the servo keeps to.
        record: New folder for the recording of the deployment; none for no recording.
    """

    task: CatchEnvCfg
    throws: int
    seed: int = 0
    perception_time: float = PERCEPTION_TIME
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
        draw, make = _plain(cfg, policy) if cfg.is_plain else _rendered(cfg, policy, stack)
        world = LockstepCfg(task=cfg.task, limits=cfg.limits, seed=cfg.seed, record=cfg.record)
        yield stack.enter_context(Lockstep(world, draw, make))


def _rendered(cfg: SteppingCfg, policy: Policy, stack: ExitStack) -> tuple[Draw, MakeBrain]:
    """What `pixel2catch twin` shows, and what `pixel2catch deploy` sees in it."""
    scene = cfg.task.scene
    view = stack.enter_context(RoomView(scene, cfg.seed))
    robot = RobotMask(scene.camera, handedness=scene.handedness)
    return lambda _, exposure: view.image(exposure), _maker(cfg, policy, SegmenterCfg(), robot)


def _plain(cfg: SteppingCfg, policy: Policy) -> tuple[Draw, MakeBrain]:
    """Red boxes, and eyes for red."""
    return plain_image, _maker(cfg, policy, SegmenterCfg(kind="color", colors=RED_HUES), None)


def _maker(cfg: SteppingCfg, policy: Policy, segmenter: SegmenterCfg, robot: RobotMask | None) -> MakeBrain:
    """Makes a brain whose perception takes its time."""
    scene = cfg.task.scene
    controller = Controller(policy, scene.handedness, scene.camera)
    prompter = make_prompter(PromptCfg(), scene.camera)

    def make(clock: Clock) -> Brain:
        slow = SlowSegmenter(make_segmenter(segmenter), clock, cfg.perception_time)
        return make_brain(controller, slow, prompter, scene.camera, robot)

    return make


def plain_image(lab: Lab, _: Exposure) -> Image:
    """A grey image with a red box where the camera would see the object."""
    camera = lab.camera
    image = np.full((camera.height, camera.width, 3), GREY, dtype=np.uint8)
    if box := lab.truth()["box"]:
        xmin, ymin, xmax, ymax = map(round, box)
        image[ymin:ymax, xmin:xmax] = RED
    return image
