"""Drivers by hand-worked numbers: from commands to targets, and from exposures to images."""

from concurrent.futures import Future

import numpy as np
import pytest

from pixel2catch.camera.image import Pixels
from pixel2catch.rendering.camera import Exposure, Moment
from pixel2catch.ros2.messages import NORMAL_SAFETY_MODE, PROTECTIVE_STOP
from pixel2catch.twin.drivers import ArmDriver, CameraDriver, HandDriver
from pixel2catch.twin.simulated_lab import JointState

HOME, LAG = np.array((0.5, -1.0)), np.array((0.1, 0.2))
REST = JointState(position=HOME, velocity=np.zeros(2))


@pytest.fixture
def arm() -> ArmDriver:
    return ArmDriver(HOME, LAG)


def test_a_step_beyond_20_rad_per_second_is_ignored_as_a_whole(arm: ArmDriver):
    """20 rad/s in 2 ms are 0.04 rad."""
    before = HOME + np.array((0.039, -0.039))
    assert np.array_equal(arm.cycle(before, REST), before)
    assert np.array_equal(arm.cycle(before + np.array((0.0, 0.041)), REST), before)
    assert arm.num_ignored == 1
    assert np.array_equal(arm.cycle(before - 0.01, REST), before - 0.01)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_no_number_moves_nothing(arm: ArmDriver, bad: float):
    for driver in (arm, HandDriver(HOME)):
        assert np.array_equal(driver.cycle(np.array((bad, -1.0)), REST), HOME)
        assert driver.num_ignored == 1


def test_a_sender_may_go_when_its_commands_stand_still(arm: ArmDriver):
    for command in (*[None] * 15, HOME + 0.01, HOME + 0.01, HOME + 1.0, *[None] * 100):  # one is ignored
        arm.cycle(command, REST)
    assert arm.is_running


def test_a_silence_of_40_ms_in_a_motion_halts_the_program(arm: ArmDriver):
    for command in (HOME + 0.01, *[None] * 20):
        arm.cycle(command, REST)
        assert arm.is_running
    arm.cycle(None, REST)
    assert (arm.is_running, arm.num_halts, arm.safety_mode) == (False, 1, NORMAL_SAFETY_MODE)
    assert np.array_equal(arm.cycle(HOME + 0.01, REST), HOME)  # where it is
    assert not arm.is_running


def test_a_halted_arm_slows_down_by_4_rad_per_second_squared_until_it_is_reset(arm: ArmDriver):
    arm.protective_stop()
    moving = JointState(position=HOME, velocity=np.array((2.0, -0.4)))
    aims = np.array([arm.cycle(None, moving) for _ in range(260)])
    assert arm.safety_mode == PROTECTIVE_STOP
    # 2 rad/s end after 0.5 s and 0.5 rad, 0.4 rad/s after 0.1 s and 0.02 rad.
    assert aims[-1] == pytest.approx(HOME + np.array((0.5, -0.02)))
    # After 0.1 s: 0.2 - 0.02 rad at 1.6 rad/s, which need 0.16 rad of lead.
    assert aims[49, 0] == pytest.approx(HOME[0] + 0.18 + 0.16)
    assert np.array_equal(aims[249], aims[-1])
    assert aims[248, 0] != aims[-1, 0]
    arm.reset(HOME + 1.0)
    aims = [arm.cycle(None, REST) for _ in range(50)]  # nobody commands
    assert np.array_equal(aims[-1], HOME + 1.0)
    assert (arm.is_running, arm.num_halts, arm.safety_mode) == (True, 1, NORMAL_SAFETY_MODE)


class SlowCamera(CameraDriver):
    def __init__(self, clock_error: float = 0.0) -> None:
        super().__init__(self._begin, clock_error)
        self.begun: list[Future[Pixels]] = []

    def _begin(self, _: Exposure) -> "Future[Pixels]":
        self.begun.append(Future())
        return self.begun[-1]

    def open(self, time: float) -> None:
        moment = Moment(qpos=np.zeros(26), qvel=np.zeros(25), time=time)
        self.expose(Exposure(moment=moment, object_name=None, thrower=lambda _: np.zeros(6)))

    def finish(self, number: int) -> None:
        self.begun[number].set_result(np.full((2, 2, 3), number, dtype=np.uint8))

    def developed(self, now: float) -> list[tuple[float, int]]:
        return [(image.stamp, int(image.pixels[0, 0, 0])) for image in self.take(now)]


def test_an_image_comes_when_it_is_due_and_not_before():
    """The stamp is too early by the clock error; the image is on time."""
    camera = SlowCamera(clock_error=0.02)
    camera.open(0.1)
    camera.finish(0)
    assert camera.developed(0.114) == []
    assert camera.developed(0.116) == [(pytest.approx(0.08), 0)]
    assert camera.developed(0.2) == []
    assert (camera.num_late, camera.num_lost) == (0, 0)


def test_a_late_image_keeps_its_time_and_is_counted_and_one_is_lost_while_two_are_in_work():
    camera = SlowCamera()
    for time in (0.1, 0.2, 0.3, 0.4):
        camera.open(time)
    assert (len(camera.begun), camera.num_lost) == (2, 2)
    camera.finish(1)
    assert camera.developed(0.216) == []  # images keep their order
    camera.finish(0)
    assert camera.developed(0.216) == [(0.1, 0), (0.2, 1)]
    assert camera.num_late == 1
    camera.open(0.5)
    assert (len(camera.begun), camera.num_lost) == (3, 2)
