"""The servo with the twin's driver of an arm, which loses cycles and ignores large steps."""

from dataclasses import replace

import numpy as np
import pytest
from servo_rows import HOME, Lab

from pixel2catch.servo.limits import JointLimits, ServoLimits
from pixel2catch.servo.link import Fault, Mode
from pixel2catch.twin.drivers import ArmDriver
from pixel2catch.twin.lab_node import twin_profile
from pixel2catch.twin.simulated_lab import JointState
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
