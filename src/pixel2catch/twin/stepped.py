"""Rehearsals in step: with rendered images, or with images of nothing but the object's box."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pixel2catch.deployment.policy_pipeline import Controller, PolicyPipeline, make_pipeline
from pixel2catch.deployment.recorder import BagRecorder, DeploymentRecorder
from pixel2catch.deployment.stepped import Nodes, PerceptionTime, StepClock, SteppedDeployment
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.color import ColorRange, ColorThreshold
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Image, Segmenter
from pixel2catch.policy import Policy
from pixel2catch.ros2.memory import Broker
from pixel2catch.ros2.profile import Profile
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.process import ServoSetup
from pixel2catch.twin.camera import Camera, Exposure, RoomCamera
from pixel2catch.twin.drivers import CYCLE
from pixel2catch.twin.lab_node import LabNode
from pixel2catch.twin.realtime import PROFILE
from pixel2catch.twin.simulated_lab import SimulatedLab
from pixel2catch.twin.trials import Outcome, RehearsalOperator, of_twin, rates, run_trial
from pixel2catch.workcells import find_workcell

HOP = 0.0005
"""Time from a cycle of the drivers to the servo's tick, and from there to the control loop [s].

Source: ours, for DDS between two processes.
"""

ROUNDING = 1e-9
"""Difference of two times that is none [s]."""

PERCEPTION_TIME = 0.010
"""Time that perception takes for an image [s]. Source: ours, background subtraction on one core."""

Draw = Callable[[SimulatedLab, Exposure], Image]
"""Draws what the camera sees."""


@dataclass(frozen=True, kw_only=True)
class SteppedRehearsalCfg:
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


class SteppedRehearsal:
    """The twin, a deployment, and an operator.

    Attributes:
        clock: The time, which goes on when somebody waits.
        broker: The network.
        lab: What is true.
        operator: Who asks for throws.
        control_loop: What catches.
    """

    def __init__(self, cfg: SteppedRehearsalCfg, draw: Draw, pipeline: PolicyPipeline) -> None:
        """Put everybody in place; nothing happens yet.

        Args:
            cfg: What is rehearsed.
            draw: Draws what the camera sees.
            pipeline: What catches.
        """
        self.clock, self.broker = clock, broker = StepClock(self._wait), Broker()
        profile, self._num_cycles = Profile.load(PROFILE), 0
        self.lab = SimulatedLab(cfg.task, cfg.seed)
        camera = Camera(lambda exposure: _done(draw(self.lab, exposure)), clock_error=cfg.clock_error)
        self._lab_node = LabNode(self.lab, profile, broker.node(clock), camera)
        self._open = ExitStack()
        node = broker.node(clock)
        recording = None
        if cfg.record:
            recording = DeploymentRecorder(
                self._open.enter_context(BagRecorder(cfg.record)), node, profile, clock, "jpeg"
            )
        nodes = Nodes(servo=broker.node(clock), loop=node, clock=clock, recording=recording)
        setup = ServoSetup(profile=profile, limits=cfg.limits)
        time = PerceptionTime(cfg.perception_time, cfg.perception_jitter, cfg.seed)
        self._robot = SteppedDeployment(setup, self.lab.camera, nodes, pipeline, time)
        self.control_loop = self._robot.control_loop
        self.operator = RehearsalOperator(broker.node(clock), profile.operator, clock)

    def close(self) -> None:
        """Free the simulation, and end the recording."""
        self._open.close()
        self.lab.close()
        self._robot.close()

    def __enter__(self) -> "SteppedRehearsal":
        """Return the rehearsal itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()

    def _wait(self, moment: float) -> None:
        """Let happen what happens until a moment [s], or shortly after."""
        while self.clock.time < moment - ROUNDING:
            self._cycle()

    def _cycle(self) -> None:
        """A cycle of the drivers, a tick of the servo, and a look of the control loop, if it is free."""
        begin = self._num_cycles * CYCLE
        self._num_cycles += 1
        self.clock.time = begin
        self._lab_node.cycle(start=0.0)
        self.clock.time = begin + HOP
        self._robot.tick()
        self.clock.time = begin + 2 * HOP
        self._robot.look()


def _done(image: Image) -> "Future[Image]":
    """An image that need not be waited for."""
    future: Future[Image] = Future()
    future.set_result(image)
    return future


GREY, RED, RED_HUES = 120, (200, 30, 20), ColorRange(hue=(340.0, 20.0))
"""Colours of plain images."""


def rehearse_stepped(
    cfg: SteppedRehearsalCfg, policy: Policy, report: Callable[[Outcome], None]
) -> dict[str, Any]:
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
    with in_step(cfg, policy) as rehearsal:
        for seed in range(cfg.seed, cfg.seed + cfg.throws):
            outcomes.append(run_trial(rehearsal.operator, seed))
            report(outcomes[-1])
        return {
            **rates(outcomes),
            "perception_time": cfg.perception_time,
            "perception_jitter": cfg.perception_jitter,
            "clock_error": cfg.clock_error,
            "deploy": rehearsal.control_loop.statistics.summary(),
            "twin": of_twin(rehearsal.operator.truth),
        }


@contextmanager
def in_step(cfg: SteppedRehearsalCfg, policy: Policy) -> Iterator[SteppedRehearsal]:
    """Twin and deployment of a rehearsal, before the first throw.

    Args:
        cfg: What is rehearsed.
        policy: What catches.
    """
    with ExitStack() as stack:
        draw, pipeline = _plain(cfg, policy) if cfg.is_plain else _rendered(cfg, policy, stack)
        yield stack.enter_context(SteppedRehearsal(cfg, draw, pipeline))


def _rendered(cfg: SteppedRehearsalCfg, policy: Policy, stack: ExitStack) -> tuple[Draw, PolicyPipeline]:
    """What `pixel2catch twin` shows, and what `pixel2catch deploy` sees in it."""
    scene = cfg.task.scene
    view = stack.enter_context(RoomCamera(scene, cfg.seed))
    robot = RobotMask(find_workcell(scene.workcell), scene.camera)
    return lambda _, exposure: view.image(exposure), _pipeline(cfg, policy, BackgroundSubtraction(), robot)


def _plain(cfg: SteppedRehearsalCfg, policy: Policy) -> tuple[Draw, PolicyPipeline]:
    """Red boxes, and eyes for red."""
    return plain_image, _pipeline(cfg, policy, ColorThreshold(RED_HUES), None)


def _pipeline(
    cfg: SteppedRehearsalCfg, policy: Policy, segmenter: Segmenter, robot: RobotMask | None
) -> PolicyPipeline:
    scene = cfg.task.scene
    controller = Controller(policy, find_workcell(scene.workcell), scene.camera)
    return make_pipeline(controller, segmenter, Prompter(), scene.camera, robot)


def plain_image(lab: SimulatedLab, _: Exposure) -> Image:
    """A grey image with a red box where the camera would see the object."""
    camera = lab.camera
    image = np.full((camera.height, camera.width, 3), GREY, dtype=np.uint8)
    if box := lab.truth()["box"]:
        xmin, ymin, xmax, ymax = map(round, box)
        image[ymin:ymax, xmin:xmax] = RED
    return image
