"""Rehearsals and recordings in simulated time: twin, servo and control loop in one process and one thread."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from functools import cache, cached_property, partial
from pathlib import Path
from random import Random
from typing import Any, final

import numpy as np

from pixel2catch.camera.image import Pixels
from pixel2catch.deployment.control_loop import Connection, ControlLoop, StepClock, SteppedServo
from pixel2catch.deployment.operator import OperatorConsole
from pixel2catch.deployment.perception import INLINE
from pixel2catch.deployment.policy_pipeline import PolicyController, PolicyPipeline
from pixel2catch.deployment.recorder import BagRecorder, DeploymentRecorder, ImageStorage
from pixel2catch.deployment.statistics import RunStatistics
from pixel2catch.deployment.throw_cycle import ThrowCycle
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
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.process import ServoSetup
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.drivers import CYCLE, CameraDriver
from pixel2catch.twin.lab_node import ROUNDING, LabNode, twin_profile
from pixel2catch.twin.rehearsal import OnThrow, RehearsalOperator, run_throws
from pixel2catch.twin.simulated_lab import SimulatedLab
from pixel2catch.workcells import find_workcell

HOP = 0.0005  #: Time from drivers to servo, and from servo to control loop [s]. Source: ours, for DDS.
GREY, RED, RED_HUES = 120, (200, 30, 20), ColorRange(hue=(340.0, 20.0))
"""Background and object in plain images, and the colours by which perception finds the object."""
NOISE, NUM_SHIFTS = 4, 32  #: Largest noise of plain images [levels]; number of its shifts along a row.

ARMING = 0.5  #: Time at which a recording arms; the switch is pressed at half of it [s]. Source: ours.
PHYSICS_HZ = 600.0  #: Physics steps in a second of a twin that is recorded. Source: ours, as evaluated.

Draw = Callable[[SimulatedLab, Exposure], Pixels]  #: Draws an image of the camera.


@final
class SteppedTwin(AbstractContextManager["SteppedTwin"]):
    """Twin and servo on a network in memory, whose time advances, cycle by cycle, while somebody waits."""

    def __init__(
        self,
        cfg: RehearsalCfg,
        task: CatchEnvCfg,
        draw: Draw,
        limits: ServoLimits | None = None,
        images: ImageStorage = "jpeg",
    ) -> None:
        """Put them in place, with the work cell's limits of the servo unless others are given."""
        self.clock, self.broker, self._open = StepClock(self._wait), Broker(), ExitStack()
        self.lab = SimulatedLab(task, cfg.seed)
        self.profile, self._num_cycles = twin_profile(self.lab.workcell), 0
        camera = CameraDriver(
            lambda exposure: INLINE.submit(draw, self.lab, exposure), 1e-3 * cfg.clock_error_ms
        )
        self._node = LabNode(self.lab, self.profile, self.broker.node(self.clock), camera)
        node, self._recording = self.broker.node(self.clock), None
        if cfg.record:
            recorder = self._open.enter_context(BagRecorder(cfg.record))
            self._recording = DeploymentRecorder(recorder, node, self.profile, self.clock, images)
        of_profile = JointLimits.of(self.lab.workcell, parts=self.profile.robots)
        limits = limits or ServoLimits.of(self.lab.workcell, of_profile)
        self.limits = replace(limits, dt=CYCLE)  #: Of the servo, which ticks after each cycle.
        setup, own = ServoSetup(profile=self.profile, limits=self.limits), self.broker.node(self.clock)
        self.servo = SteppedServo(setup, (own, node), self.clock, self._recording)
        #: Called after every cycle of the drivers, each `HOP` later than the one before.
        self.followers: tuple[Callable[[], object], ...] = (self.servo.tick,)

    @cached_property
    def operator(self) -> RehearsalOperator:
        """The operator; created on first use, because the servo obeys only one."""
        return RehearsalOperator(self.broker.node(self.clock), self.profile.operator, self.clock)

    def _wait(self, moment: float) -> None:
        while self.clock.time < moment - ROUNDING:
            self.clock.time = begin = self._num_cycles * CYCLE
            self._num_cycles += 1
            self._node.cycle(start=0.0)
            for number, follow in enumerate(self.followers, start=1):
                self.clock.time = begin + number * HOP
                follow()

    def __exit__(self, *exception: object) -> None:
        """Free the simulation, and end the recording; raises if that lacks messages."""
        self._open.close()
        self.lab.close()
        self.servo.close()
        if self._recording and exception[0] is None:
            self._recording.require_whole()


def rehearse_stepped(
    cfg: RehearsalCfg, task: CatchEnvCfg, policy: Policy, on_throw: OnThrow
) -> dict[str, Any]:
    """Run throws in simulated time; return the report. Raises as `in_step` does."""
    with in_step(cfg, task, policy) as (twin, statistics):
        return {
            **run_throws(cfg, twin.operator, on_throw),
            "perception_time": 1e-3 * cfg.perception_ms,
            "perception_jitter": 1e-3 * cfg.perception_jitter_ms,
            "clock_error": 1e-3 * cfg.clock_error_ms,
            "deploy": statistics.summary(),
        }


@contextmanager
def in_step(
    cfg: RehearsalCfg, task: CatchEnvCfg, policy: Policy
) -> Iterator[tuple[SteppedTwin, RunStatistics]]:
    """Yield a rehearsal before its first throw, and the statistics of the deployment.

    Images and perception are those of `pixel2catch twin` and `pixel2catch deploy`. Plain images show a red
    box instead, which perception finds by its colour.
    """
    camera, workcell = task.sensing.camera.camera, find_workcell(task.scene.workcell)
    with ExitStack() as stack:
        if cfg.plain:
            draw, segmenter, robot = plain_image, ColorThreshold(RED_HUES), None
        else:
            room = stack.enter_context(RoomCamera(task.scene, cfg.seed))
            draw, segmenter = (lambda _, exposure: room.image(exposure)), BackgroundSubtraction()
            robot = RobotMask(workcell, camera)
        controller = PolicyController(policy, workcell, camera)
        pipeline = PolicyPipeline(controller, segmenter, Prompter(), camera, robot)
        twin = stack.enter_context(SteppedTwin(cfg, task, draw))
        least, jitter = 1e-3 * cfg.perception_ms, 1e-3 * cfg.perception_jitter_ms
        cycle, times = None, partial(Random(cfg.seed).uniform, least, least + jitter)
        if cfg.after_catch:
            place, limits = cfg.after_catch, twin.limits
            cycle = ThrowCycle(pipeline, twin.profile, limits, camera, place, is_stepped=True)
        deployment = pipeline, camera, twin.servo.connection, twin.profile
        loop = ControlLoop(*deployment, perception_time=times, cycle=cycle)
        twin.followers = (twin.servo.tick, loop.poll)
        yield twin, loop.statistics


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
    """Yield the connection to a twin with the robot of a dynamics file, armed and recorded into a folder."""
    scene = SceneCfg(workcell=workcell.name, physics_hz=PHYSICS_HZ)
    task, is_armed = CatchEnvCfg(scene=scene).with_files(dynamics, None), False
    with SteppedTwin(RehearsalCfg(record=out), task, plain_image, limits, "none") as twin:
        operator = OperatorConsole(twin.broker.node(twin.clock), twin.profile.operator, twin.clock)

        def operate() -> None:
            nonlocal is_armed
            operator.holds = twin.clock.now() > ARMING / 2
            operator.watch()
            if twin.clock.now() > ARMING and not is_armed:
                operator.arm()
                is_armed = True

        twin.followers = (twin.servo.tick, operate)
        yield twin.servo.connection
