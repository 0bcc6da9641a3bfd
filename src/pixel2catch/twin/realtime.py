"""The twin in real time, or at the stated rate of a slower clock."""

import gc
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.errors import DeploymentError
from pixel2catch.ros2.profile import Profile
from pixel2catch.ros2.transport import Clock, RealClock, make_transport
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.process import set_niceness
from pixel2catch.twin.camera import Camera, drawing_process
from pixel2catch.twin.drivers import CYCLE
from pixel2catch.twin.lab_node import LabNode
from pixel2catch.twin.processes import FIRST, child
from pixel2catch.twin.simulated_lab import SimulatedLab

LATE = 0.01
"""How late a cycle is that is counted [s]. Source: ours, half of what the servo lets joint states age."""

PROFILE = "ur5e_allegro_v4"
"""Robot profile that the twin speaks."""


@dataclass(frozen=True, kw_only=True)
class TwinCfg:
    """What the twin is the twin of.

    Attributes:
        task: What is thrown at which robot, seen by which camera.
        seed: Of the room, the first start pose and all noise.
        clock: Seconds of the twin in a real second.
        web: Port of the web page; none if absent.
    """

    task: CatchEnvCfg
    seed: int = 0
    clock: float = 1.0
    web: int | None = None


@dataclass(frozen=True, kw_only=True)
class ClockStats:
    """How well the twin keeps to its clock.

    Attributes:
        num_cycles: Cycles so far.
        num_late: Those of them that began more than `LATE` after their time; none is left out.
        worst: The latest [s].
    """

    num_cycles: int = 0
    num_late: int = 0
    worst: float = 0.0

    def counted(self, lateness: float) -> "ClockStats":
        """The pace with one cycle more, so late [s]."""
        return ClockStats(
            num_cycles=self.num_cycles + 1,
            num_late=self.num_late + (lateness > LATE),
            worst=max(self.worst, lateness),
        )


OnCycle = Callable[[LabNode, ClockStats], bool]
"""Called after every cycle; says whether to go on."""


def serve(cfg: TwinCfg, on_cycle: OnCycle) -> ClockStats:
    """Be the lab on this machine's DDS network.

    Args:
        cfg: What the twin is the twin of.
        on_cycle: Called after every cycle.

    Returns:
        How well it kept to the clock.

    Raises:
        DeviceUnavailableError: If no OpenGL back end works.
        DeploymentError: If DDS cannot be started, or the page lacks a package.
    """
    clock, scene, profile = RealClock(cfg.clock), cfg.task.scene, Profile.load(PROFILE)
    set_niceness(FIRST)
    with (
        _page(cfg, profile),
        drawing_process(scene, cfg.seed) as draw,
        make_transport("dds", "pixel2catch_twin", loopback=True, clock=clock) as node,
        SimulatedLab(cfg.task, cfg.seed) as lab,
    ):
        return run(LabNode(lab, profile, node, Camera(draw)), clock, on_cycle)


def _page(cfg: TwinCfg, profile: Profile) -> AbstractContextManager[None]:
    """The process that serves the web page, if there is to be one."""
    if cfg.web is None:
        return nullcontext()
    if find_spec("viser") is None:
        raise DeploymentError("the page needs viser: pip install 'pixel2catch[twin]', or leave out --web.")
    return child(_serve_page, cfg.web, cfg.task.scene, profile, cfg.clock)


def _serve_page(port: int, scene: SceneCfg, profile: Profile, rate: float) -> None:
    from pixel2catch.twin.page import serve_page  # where viser is not installed, nobody comes here

    serve_page(port, scene, profile, rate)


def run(lab_node: LabNode, clock: Clock, on_cycle: OnCycle) -> ClockStats:
    """Run cycle after cycle, each at its time; those that are late are made up for.

    Args:
        lab_node: The twin.
        clock: Its clock.
        on_cycle: Called after every cycle.

    Returns:
        How well it kept to the clock.
    """
    gc.collect()
    gc.freeze()  # what there is now stays: it need not be looked through again and again
    begin, start = clock.now(), clock.stamp()
    stats = ClockStats()
    while True:
        clock.sleep_until(begin + lab_node.time)
        lateness = clock.now() - begin - lab_node.time
        lab_node.cycle(start, int(lateness / CYCLE))
        stats = stats.counted(lateness)
        if not on_cycle(lab_node, stats):
            return stats
