"""Speeds and a stop of a simulated arm under the servo's limits; `test_servo_core` has other lags."""

from contextlib import closing
from dataclasses import replace

import numpy as np
from servo_rows import HOME, LIMITS, Lab, given

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.servo.link import Fault
from pixel2catch.twin.simulated_lab import SimulatedLab

PHYSICS_HZ = 510.0
"""A tick of the servo is a step of the physics; it must be a multiple of the control rate."""

FASTEST = 3.14  #: Speed limit of a UR5e's joints [rad/s]; its specification here has 2.79.
SPUN_OUT = 14  #: Ticks in which motion from before a stop still accelerates joints.
SWING = np.array([0.5, 0.3, 0.3, 0.5, 0.5])
"""Swing to each side of the start pose [rad]; no joint reaches the end of its travel."""


class PhysicalLab(Lab):
    def __init__(self, robot: SimulatedLab) -> None:
        super().__init__(limits=replace(LIMITS, dt=1.0 / PHYSICS_HZ))
        self._robot = robot
        self.joint_pos[0] = self.target[0] = robot.joints.position
        self.speeds: list[np.ndarray] = []

    def follow(self, command: np.ndarray) -> None:
        self._robot.step(command[0])
        self.joint_pos[0] = self._robot.joints.position
        self.speeds.append(self._robot.joints.velocity[:5])


def test_a_swing_at_the_largest_speed_and_a_stop_in_its_middle():
    task = CatchEnvCfg()
    task = replace(task, scene=replace(task.scene, physics_hz=PHYSICS_HZ))
    with closing(SimulatedLab(task, seed=0)) as robot:
        (lab := PhysicalLab(robot)).started()
        for swing in range(4):
            lab.target[0, :5] = HOME[:5] + (SWING if swing % 2 else -SWING)
            lab.run(0.3 if swing < 3 else 0.15)
        first = len(lab.speeds) + SPUN_OUT
        lab.tick(given(is_stop_requested=np.array([True])))
        assert lab.run(STOP_TIME)["stopped_by"] == Fault.STOP_REQUEST
    assert 0.6 * FASTEST < np.abs(lab.speeds).max() < FASTEST
    assert np.abs(lab.speeds[-1]).max() < 0.1
    stop = np.diff(lab.speeds[first:], axis=0) * PHYSICS_HZ
    assert np.abs(stop).max() < 2.0 * lab.limits.joints.deceleration[0]
