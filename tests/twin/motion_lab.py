"""A stepped twin whose robot starts in any pose, with an operator who holds the switch and arms."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch

from pixel2catch.cli.home import QUARTER
from pixel2catch.deployment.follower import follow
from pixel2catch.deployment.operator import OperatorConsole
from pixel2catch.deployment.paths import Motion
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.ros2.profile import Place
from pixel2catch.scene.distances import Distances
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.link import Command
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.drivers import CYCLE
from pixel2catch.twin.lab_node import twin_profile
from pixel2catch.twin.stepped import SteppedTwin, plain_image
from pixel2catch.workcells import find_workcell

WORKCELL = find_workcell("ur5e_allegro")
HOME = np.array([joint.home for joint in WORKCELL.joints])
TWIN = twin_profile(WORKCELL)
PROFILE = replace(TWIN, places={"near": Place(joints={"shoulder_pan_joint": 2.8}), **TWIN.places})
LIMITS = ServoLimits.of(WORKCELL)
SLOW = ServoLimits.of(WORKCELL, JointLimits.of(WORKCELL, QUARTER))
ARMED = 0.3  #: Time at which the operator arms [s].


class MotionLab:
    """The twin; the smallest distances, and the largest speeds, of its simulated robot so far."""

    def __init__(self, twin: SteppedTwin, *, measures: bool) -> None:
        self.twin, self.distances = twin, Distances(twin.lab.workcell)
        self.connection = twin.servo.connection
        self.nearest = np.full(2, np.inf)  #: Robot and table, arm and robot [m].
        self.fastest = np.zeros(len(twin.lab.workcell.joints))  #: [rad/s]
        self._operator = OperatorConsole(twin.broker.node(twin.clock), twin.profile.operator, twin.clock)
        self._measures = measures
        twin.followers = (twin.servo.tick, self._operate)

    @property
    def joint_pos(self) -> np.ndarray:
        return self.twin.lab.joints.position

    def follow(
        self,
        plan: Callable[[np.ndarray], Motion],
        on_command: Callable[[Command], None] = lambda _: None,
    ) -> bool:
        """Let the robot follow a motion; return whether it did to the end."""
        topic = self.twin.profile.operator.status
        return follow(plan, "motion", self.connection, topic, self.is_late, lambda _: None, on_command)

    def is_late(self) -> bool:
        return self.twin.clock.time > 60.0

    def place(self, joint_pos: np.ndarray) -> None:
        """Put the simulated robot into a pose [rad]."""
        lab = self.twin.lab
        lab._qpos[: len(joint_pos)], lab._qvel[:] = joint_pos - lab._encoder_offset, 0.0
        start = torch.from_numpy(lab._qpos[None, : len(joint_pos)].copy())
        lab._world._actuators.reset(torch.ones(1, dtype=torch.bool), start, lab.episode.parameters)
        self.twin._node._hold_still()

    def _operate(self) -> None:
        now = self.twin.clock.time
        self._operator.holds = now > ARMED / 2
        self._operator.watch()
        if ARMED <= now < ARMED + CYCLE:
            self._operator.arm()
        self.fastest = np.maximum(self.fastest, np.abs(self.twin.lab.joints.velocity))
        if self._measures and round(now / CYCLE) % 8 == 0:
            found = self.distances.at(self.joint_pos)
            self.nearest = np.minimum(self.nearest, [each.distance for each in found[:2]])


@contextmanager
def motion_lab(limits: ServoLimits = SLOW, *, measures: bool = False) -> Iterator[MotionLab]:
    task = CatchEnvCfg(scene=SceneCfg(workcell=limits.workspace.workcell.name, physics_hz=120.0))
    with SteppedTwin(RehearsalCfg(), task, plain_image, limits) as twin:
        yield MotionLab(twin, measures=measures)
