"""Rehearsals and recordings in simulated time: twin, servo and control loop in one process and one thread."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, closing, contextmanager
from functools import cache, cached_property
from pathlib import Path
from typing import Any, final

import numpy as np

from pixel2catch.camera.image import Pixels
from pixel2catch.deployment.control_loop import (
    Connection,
    ControlLoop,
    StepClock,
    SteppedServo,
    perception_times,
)
from pixel2catch.deployment.operator import OperatorConsole
from pixel2catch.deployment.policy_pipeline import PolicyController, PolicyPipeline, make_pipeline
from pixel2catch.deployment.recorder import BagRecorder, DeploymentRecorder
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.regions import RobotMask
from pixel2catch.perception.segmenter import ColorRange, ColorThreshold
from pixel2catch.perception.tracker import Prompter
from pixel2catch.policy import Policy
from pixel2catch.rendering.camera import Exposure, RoomCamera
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.ros2.memory import Broker
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.limits import ServoLimits
from pixel2catch.servo.process import ServoSetup
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.drivers import CYCLE, CameraDriver
from pixel2catch.twin.lab_node import ROUNDING, LabNode, twin_profile
from pixel2catch.twin.rehearsal import OnThrow, RehearsalOperator, run_throws
from pixel2catch.twin.simulated_lab import SimulatedLab
from pixel2catch.workcells import find_workcell

HOP = 0.0005
"""Time from a cycle of the drivers to the servo's tick, and from there to the control loop [s].

Source: ours, for DDS between two processes.
"""

GREY, RED, RED_HUES = 120, (200, 30, 20), ColorRange(hue=(340.0, 20.0))
"""Background and object in plain images, and the colours by which perception finds the object."""
NOISE, NUM_SHIFTS = 4, 32
"""Largest noise of plain images [levels]; number of different shifts of it along a row."""

ARMING = 0.5  #: Time at which a recording arms; the switch is pressed at half of it [s]. Source: ours.
PHYSICS_HZ = 600.0  #: Physics steps in a second of a twin that is recorded. Source: ours, as evaluated.

Draw = Callable[[SimulatedLab, Exposure], Pixels]  #: Draws an image of the camera.


@final
class SteppedTwin:
    """The twin on a network in memory, whose time advances, cycle by cycle, while somebody waits."""

    def __init__(self, task: CatchEnvCfg, seed: int, draw: Draw, clock_error: float = 0.0) -> None:
        """Put it in place; stamps of images are too early by the clock error [s]."""
        self.clock, self.broker = StepClock(self._wait), Broker()
        self.profile, self._num_cycles = twin_profile(find_workcell(task.scene.workcell)), 0
        self.lab = SimulatedLab(task, seed)
        camera = CameraDriver(lambda exposure: _done(draw(self.lab, exposure)), clock_error)
        self._node = LabNode(self.lab, self.profile, self.broker.node(self.clock), camera)
        #: Called after every cycle of the drivers, each `HOP` later than the one before.
        self.followers: tuple[Callable[[], object], ...] = ()

    def _wait(self, moment: float) -> None:
        """Run cycles until a moment [s], or shortly after."""
        while self.clock.time < moment - ROUNDING:
            begin = self._num_cycles * CYCLE
            self._num_cycles += 1
            self.clock.time = begin
            self._node.cycle(start=0.0)
            for number, follow in enumerate(self.followers, start=1):
                self.clock.time = begin + number * HOP
                follow()


def _done(image: Pixels) -> "Future[Pixels]":
    future: Future[Pixels] = Future()
    future.set_result(image)
    return future


class SteppedRehearsal:
    """The twin, a deployment, and an operator in simulated time."""

    def __init__(
        self,
        cfg: RehearsalCfg,
        task: CatchEnvCfg,
        draw: Draw,
        pipeline: PolicyPipeline,
        limits: ServoLimits | None = None,
    ) -> None:
        """Put them in place, with the work cell's limits of the servo unless others are given."""
        twin = SteppedTwin(task, cfg.seed, draw, 1e-3 * cfg.clock_error_ms)
        clock, broker = twin.clock, twin.broker
        self.clock, self.broker, self.lab = clock, broker, twin.lab
        self._open, self._recording = ExitStack(), None
        node = broker.node(clock)
        if cfg.record:
            recorder = self._open.enter_context(BagRecorder(cfg.record))
            self._recording = DeploymentRecorder(recorder, node, twin.profile, clock, "jpeg")
        limits = limits or ServoLimits.of(find_workcell(task.scene.workcell))
        setup = ServoSetup(profile=twin.profile, limits=limits)
        times = perception_times(1e-3 * cfg.perception_ms, 1e-3 * cfg.perception_jitter_ms, cfg.seed)
        self._servo = SteppedServo(setup, (broker.node(clock), node), clock, self._recording)
        connection, profile = self._servo.connection, twin.profile
        loop = ControlLoop(pipeline, self.lab.camera, connection, profile, perception_time=times)
        self.statistics, self._topics = loop.statistics, twin.profile.operator
        twin.followers = (self._servo.tick, loop.poll)

    @cached_property
    def operator(self) -> RehearsalOperator:
        """The operator; created on first use, because the servo obeys only one."""
        return RehearsalOperator(self.broker.node(self.clock), self._topics, self.clock)

    def close(self) -> None:
        """Free the simulation, and end the recording.

        Raises:
            DeploymentError: The recording lacks messages.
        """
        self._open.close()
        self.lab.close()
        self._servo.close()
        if self._recording:
            self._recording.require_whole()


def rehearse_stepped(
    cfg: RehearsalCfg,
    task: CatchEnvCfg,
    policy: Policy,
    on_throw: OnThrow,
    limits: ServoLimits | None = None,
) -> dict[str, Any]:
    """Run throws in simulated time; return the report.

    Raises:
        DeviceUnavailableError: Images are rendered, and no OpenGL back end works.
        PolicyMismatchError: The policy cannot be deployed.
    """
    with in_step(cfg, task, policy, limits) as rehearsal:
        return {
            **run_throws(cfg, rehearsal.operator, on_throw),
            "perception_time": 1e-3 * cfg.perception_ms,
            "perception_jitter": 1e-3 * cfg.perception_jitter_ms,
            "clock_error": 1e-3 * cfg.clock_error_ms,
            "deploy": rehearsal.statistics.summary(),
        }


@contextmanager
def in_step(
    cfg: RehearsalCfg, task: CatchEnvCfg, policy: Policy, limits: ServoLimits | None = None
) -> Iterator[SteppedRehearsal]:
    """Yield a rehearsal before its first throw.

    Images and perception are those of `pixel2catch twin` and `pixel2catch deploy`. Plain images show a red
    box instead, which perception finds by its colour.
    """
    scene = task.scene
    workcell = find_workcell(scene.workcell)
    with ExitStack() as stack:
        if cfg.plain:
            draw, segmenter, robot = plain_image, ColorThreshold(RED_HUES), None
        else:
            camera = stack.enter_context(RoomCamera(scene, cfg.seed))
            draw, segmenter = (lambda _, exposure: camera.image(exposure)), BackgroundSubtraction()
            robot = RobotMask(workcell, scene.camera)
        controller = PolicyController(policy, workcell, scene.camera)
        pipeline = make_pipeline(controller, segmenter, Prompter(), scene.camera, robot)
        yield stack.enter_context(closing(SteppedRehearsal(cfg, task, draw, pipeline, limits)))


def plain_image(lab: SimulatedLab, _: Exposure) -> Pixels:
    """Return a grey image with a red box around the visible part of the object; no two in a row are equal."""
    camera = lab.camera
    shift = round(lab.time / CONTROL_DT) % NUM_SHIFTS
    image = _grey(camera.height, camera.width + NUM_SHIFTS)[:, shift : shift + camera.width].copy()
    if box := lab.truth()["box"]:
        xmin, ymin, xmax, ymax = map(round, box)
        image[ymin:ymax, xmin:xmax] = RED
    return image


@cache
def _grey(height: int, width: int) -> Pixels:
    noise = np.random.default_rng(0).integers(-NOISE, NOISE + 1, (height, width, 3))
    return (GREY + noise).astype(np.uint8)


@contextmanager
def recorded_in_step(
    workcell: WorkcellSpec, dynamics: Path, limits: ServoLimits, out: Path
) -> Iterator[Connection]:
    """Yield the connection to a twin with the robot of a dynamics file, which is armed and recorded.

    The recording is written into a new folder.
    """
    scene = SceneCfg(workcell=workcell.name, physics_hz=PHYSICS_HZ)
    twin = SteppedTwin(CatchEnvCfg(scene=scene).with_files(dynamics, None), 0, plain_image)
    clock, node = twin.clock, twin.broker.node(twin.clock)
    operator = OperatorConsole(twin.broker.node(clock), twin.profile.operator, clock)
    with closing(twin.lab), BagRecorder(out) as recorder:
        recording = DeploymentRecorder(recorder, node, twin.profile, clock, "none")
        setup = ServoSetup(profile=twin.profile, limits=limits)
        servo, is_armed = SteppedServo(setup, (twin.broker.node(clock), node), clock, recording), False

        def operate() -> None:
            nonlocal is_armed
            operator.holds = clock.now() > ARMING / 2
            operator.watch()
            if clock.now() > ARMING and not is_armed:
                operator.arm()
                is_armed = True

        twin.followers = (servo.tick, operate)
        with closing(servo):
            yield servo.connection
