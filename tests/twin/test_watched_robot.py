"""What the servo does where the twin's drivers, joints or commands fail, in stepped time."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from servo_rows import HOME, Lab

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.limits import STOP_TIME, JointLimits, ServoLimits
from pixel2catch.servo.link import Command, Fault, Mode
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.drivers import ArmDriver
from pixel2catch.twin.lab_node import twin_profile
from pixel2catch.twin.rehearsal import POLL
from pixel2catch.twin.simulated_lab import JointState
from pixel2catch.twin.stepped import SteppedTwin, plain_image
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

TASK = CatchEnvCfg(scene=SceneCfg(physics_hz=120.0))


@pytest.fixture
def twin() -> Iterator[SteppedTwin]:
    with SteppedTwin(RehearsalCfg(plain=True), TASK, plain_image) as twin:
        yield twin


def wait(twin: SteppedTwin, seconds: float) -> Command:
    """Let the operator watch for a time [s]; return the newest command."""
    for _ in range(round(seconds / POLL)):
        twin.operator.watch()
        twin.clock.sleep_until(twin.clock.now() + POLL)
    return [*twin.servo.connection.receive()][-1]


def test_play_after_a_protective_stop_moves_nothing(twin: SteppedTwin):
    """An arm that was displaced by less than what counts as moved stays where it is."""
    operator, lab = twin.operator, twin.lab
    wait(twin, 0.5)
    operator.holds = True
    wait(twin, 0.2)
    operator.arm()
    assert wait(twin, 0.2).mode == Mode.ARMED
    operator.request(do="protective_stop")
    assert wait(twin, 0.1).mode == Mode.STOPPED
    last = wait(twin, STOP_TIME)
    assert last.mode == Mode.IDLE
    arm = twin.profile.robots[0].ids
    lab._qpos[arm] += 0.03
    operator.request(do="resume")
    displaced = lab.joints.position[arm]
    assert np.isnan(wait(twin, 1.0).joint_pos_command).all()
    assert lab.truth()["joint_speed"] < 0.05
    np.testing.assert_allclose(lab.joints.position[arm], displaced, atol=2e-3)
    np.testing.assert_allclose(displaced, last.joint_pos[arm] + 0.03, atol=2e-3)


@pytest.mark.parametrize("num_missed", [3, 60])
def test_commands_survive_missed_cycles_and_a_driver_that_ignores_them_is_named(num_missed: int):
    """The arm swings as fast as it may; the twin's driver loses bursts of cycles, as UR's does."""
    profile = twin_profile(UR5E_ALLEGRO)
    limits = ServoLimits.of(UR5E_ALLEGRO, JointLimits.of(UR5E_ALLEGRO, parts=profile.robots))
    driver = ArmDriver(HOME[:6], limits.joints.lag[:6])
    lab = Lab(limits=replace(limits, ramp_time=0.1)).started()
    rest = JointState(position=HOME[:6], velocity=np.zeros(6))
    target = HOME.copy()
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
