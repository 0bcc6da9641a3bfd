"""The twin in real time, or at the stated rate of a slower clock, and the processes that it starts.

They end when it does, however it ends.
"""

import gc
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context

import torch

from pixel2catch.camera.image import Pixels
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.interruption import end_with_parent
from pixel2catch.rendering.camera import Exposure, RoomCamera
from pixel2catch.rendering.renderer import find_gl_backend
from pixel2catch.ros2.factory import make_transport
from pixel2catch.ros2.transport import LOOPBACK, Clock, RealClock
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.link import set_niceness
from pixel2catch.twin.config import TwinCfg
from pixel2catch.twin.drivers import CYCLE, Camera
from pixel2catch.twin.lab_node import LabNode, twin_profile
from pixel2catch.twin.simulated_lab import SimulatedLab
from pixel2catch.workcells import find_workcell

FIRST, SECOND = -10, -5  #: Niceness of physics and wires, and of camera. Source: ours.


def obey_parent(niceness: int) -> None:
    """Call this first in such a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the twin's
    set_niceness(niceness)
    end_with_parent()


@contextmanager
def drawing_process(scene: SceneCfg, seed: int) -> Iterator[Callable[[Exposure], "Future[Pixels]"]]:
    """A process that draws what the camera sees, so that the physics keeps its time.

    It yields a function that begins to draw. The seed is of the room's looks and the sensor's noise.

    Raises:
        DeviceUnavailableError: If no OpenGL back end works.
    """
    find_gl_backend()
    with ProcessPoolExecutor(1, get_context("spawn"), _open, (scene, seed)) as process:
        process.submit(bool).result()  # its view is open
        yield lambda exposure: process.submit(_draw, exposure)


_VIEWS: list[RoomCamera] = []  #: The view of a process that draws.


def _open(scene: SceneCfg, seed: int) -> None:
    obey_parent(SECOND)
    torch.set_num_threads(1)
    _VIEWS.append(RoomCamera(scene, seed))


def _draw(exposure: Exposure) -> Pixels:
    return _VIEWS[0].image(exposure)


LATE = 0.01
"""How late a cycle is that is counted [s]. Source: ours, half of what the servo lets joint states age."""


@dataclass(kw_only=True)
class ClockStats:
    """How well the twin keeps to its clock."""

    num_cycles: int = 0  #: Cycles so far.
    num_late: int = 0  #: Those of them that began more than `LATE` after their time; none is left out.
    worst: float = 0.0  #: The latest [s].

    def count(self, lateness: float) -> None:
        """Note a cycle that began so late [s]."""
        self.num_cycles += 1
        self.num_late += lateness > LATE
        self.worst = max(self.worst, lateness)


OnCycle = Callable[[LabNode, ClockStats], bool]  #: Called after every cycle; says whether to go on.


def serve(cfg: TwinCfg, task: CatchEnvCfg, on_cycle: OnCycle) -> ClockStats:
    """Be the lab of a task on this machine's DDS network; return how well it kept to the clock.

    Raises:
        DeviceUnavailableError: If no OpenGL back end works.
        DeploymentError: If DDS cannot be started.
    """
    clock, scene = RealClock(cfg.clock), task.scene
    profile = twin_profile(find_workcell(scene.workcell))
    set_niceness(FIRST)
    with (
        drawing_process(scene, cfg.seed) as draw,
        make_transport("dds", "pixel2catch_twin", LOOPBACK, clock) as node,
        closing(SimulatedLab(task, cfg.seed)) as lab,
    ):
        return run(LabNode(lab, profile, node, Camera(draw)), clock, on_cycle)


def run(lab_node: LabNode, clock: Clock, on_cycle: OnCycle) -> ClockStats:
    """Run cycle after cycle, each at its time; those that are late are made up for."""
    gc.collect()
    gc.freeze()  # what there is now stays: it need not be looked through again and again
    begin, start = clock.now(), clock.stamp()
    stats = ClockStats()
    while True:
        clock.sleep_until(begin + lab_node.time)
        lateness = clock.now() - begin - lab_node.time
        lab_node.cycle(start, int(lateness / CYCLE))
        stats.count(lateness)
        if not on_cycle(lab_node, stats):
            return stats
