"""The servo with drivers that lose cycles, ignore large steps or hold commands, and with a physical arm."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from servo_rows import HOME, LIMITS, Lab, given

from paper_robot import JOINTS
from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.ros2.profile import Profile
from pixel2catch.servo.limits import STOP_TIME, JointLimits, ServoLimits
from pixel2catch.servo.link import Fault, Mode
from pixel2catch.twin.drivers import ArmDriver
from pixel2catch.twin.lab_node import twin_profile
from pixel2catch.twin.simulated_lab import JointState, SimulatedLab
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO


@pytest.mark.parametrize("num_missed", [3, 60])
def test_commands_survive_missed_cycles_and_a_driver_that_ignores_them_is_named(num_missed: int):
    """The arm swings as fast as it may; the twin's driver loses bursts of cycles, as UR's does."""
    profile = twin_profile(UR5E_ALLEGRO)
    limits = ServoLimits.of(UR5E_ALLEGRO, JointLimits.of(UR5E_ALLEGRO, parts=profile.robots))
    driver = ArmDriver(HOME[:6], limits.joints.lag[:6])
    lab = Lab(limits=replace(limits, ramp_time=0.1)).started()
    rest = JointState(position=HOME[:6], velocity=np.zeros(6))
    target, output = HOME.copy(), lab.state
    for tick in range(1500):
        lab.target[0, :6] = HOME[:6] + (0.4 if tick // 150 % 2 else -0.4) * np.array((1, 0, 0, 1, 1, 1))
        if tick % 97 == 50:
            driver.num_missed = num_missed
        before, output = lab.joint_pos.copy(), lab.tick()
        if output["mode"][0] != Mode.RUN:
            break
        target[:6], target[6:] = driver.cycle(output["sent"][0, :6], rest), output["sent"][0, 6:]
        lab.joint_pos = before
        lab.follow(target[None])
    assert (driver.num_ignored > 0) == (num_missed > 3)
    expected = (Mode.RUN, 0) if num_missed == 3 else (Mode.STOPPED, Fault.COMMANDS_IGNORED)
    assert (output["mode"][0], output["stopped_by"][0]) == expected


@pytest.mark.parametrize("phase", [0, 2, 4])
def test_fingers_are_as_fast_as_in_training_behind_a_driver_that_holds_commands(phase: int):
    """At 100 Hz: a command holds for five ticks, a position is up to four old when it is used."""
    profile = Profile.load("ur5e_allegro_v4")
    joints, fingers = JointLimits.of(UR5E_ALLEGRO, parts=profile.robots), slice(7, 15, 3)
    lab = Lab(limits=replace(LIMITS, joints=joints)).started()
    lab.target[0, fingers] = 1.6
    held, seen, stamp, positions = lab.joint_pos, lab.joint_pos, lab.time, [lab.joint_pos[0, fingers].copy()]
    for tick in range(75):
        if tick % 5 == 0:
            seen, stamp = lab.joint_pos.copy(), lab.time + LIMITS.dt
        before = lab.joint_pos.copy()
        sent = lab.tick(given(joint_pos=seen, joint_stamp=np.full((1, len(JOINTS)), stamp)))["sent"]
        held = sent if tick % 5 == phase else held
        lab.joint_pos = before
        lab.follow(held)
        positions.append(lab.joint_pos[0, fingers].copy())
    limits = np.array([each.velocity_limit for each in JOINTS])[fingers]
    speed = (positions[75] - positions[50]) / (25 * LIMITS.dt)
    np.testing.assert_allclose(speed, 0.9 * limits, rtol=0.03)


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
