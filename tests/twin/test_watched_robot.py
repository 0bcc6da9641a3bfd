"""What the servo does where the twin's drivers, joints or commands fail, in stepped time."""

from collections.abc import Iterator

import numpy as np
import pytest

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.scene.scene import SceneCfg
from pixel2catch.servo.limits import STOP_TIME
from pixel2catch.servo.link import Command, Mode
from pixel2catch.twin import RehearsalCfg
from pixel2catch.twin.rehearsal import POLL
from pixel2catch.twin.stepped import SteppedTwin, plain_image

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
