"""Implausible positions: frozen, shifted, drifting; and plausible motions."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from servo_rows import HOME, Lab, noisy

from pixel2catch.servo.laws import FROZEN_ANGLE, FROZEN_TIME
from pixel2catch.servo.link import Fault, Mode
from pixel2catch.servo.state import ServoInputs

ARM, FINGERS, ELBOW = range(6), range(6, len(HOME)), 2
NUM = len(HOME)
Distort = Callable[[ServoInputs], ServoInputs]


def frozen(joints: range | int) -> Distort:
    """Return a fault: joints repeat their position with new stamps."""
    kept: list[np.ndarray] = []

    def distort(good: ServoInputs) -> ServoInputs:
        kept.append(good.joint_pos.copy())
        is_frozen = np.isin(np.arange(NUM), joints)
        return replace(good, joint_pos=np.where(is_frozen, kept[0], good.joint_pos))

    return distort


def until_stopped(lab: Lab, seconds: float, distort: Distort) -> float:
    """Time until the robot stops [s]; infinite if it does not."""
    begin = lab.time
    while lab.time < begin + seconds:
        if lab.tick(distort)["mode"][0] == Mode.STOPPED:
            return lab.time - begin
    return np.inf


@pytest.mark.parametrize(("joint", "motion"), [(0, -0.02), (ELBOW, -0.3)])
def test_a_frozen_joint_of_an_arm_stops_it_within_a_fifth_of_a_second(joint: int, motion: float):
    """Also with a small target; the command needs 2 control steps at most for the small angle."""
    lab = Lab().started()
    lab.target[0, joint] += motion
    time = until_stopped(lab, 1.0, frozen(joint))
    assert lab.outputs[-1]["stopped_by"][0] in (Fault.JOINTS_FROZEN, Fault.TRACKING_ERROR)
    assert time < FROZEN_TIME + 2.0 / 30.0
    assert FROZEN_TIME <= 0.2


def test_a_frozen_arm_without_motion_is_no_fault():
    lab = Lab().started()
    lab.target[0, ELBOW] += 0.8 * FROZEN_ANGLE
    assert until_stopped(lab, 1.0, frozen(ARM)) == np.inf


def test_a_hand_that_is_frozen_as_a_whole_stops():
    lab = Lab().started()
    lab.target[0, FINGERS] += 0.3
    assert until_stopped(lab, 1.0, frozen(FINGERS)) < 0.25
    assert lab.outputs[-1]["stopped_by"][0] == Fault.JOINTS_FROZEN


@pytest.mark.parametrize("seconds", [0.0, 2.0])
def test_an_elbow_measured_with_an_offset_stops(seconds: float):
    """0.1 rad, at once or slowly, while the arm holds a pose and after a swing."""
    for moves in (False, True):
        lab = Lab().started()
        lab.target[0, :3] += 0.3 * moves
        begin = lab.time

        def distort(good: ServoInputs, begin: float = begin) -> ServoInputs:
            share = 1.0 if seconds == 0.0 else min((good.now[0] - begin) / seconds, 1.0)
            return replace(good, joint_pos=good.joint_pos + 0.1 * share * (np.arange(NUM) == ELBOW))

        assert until_stopped(lab, seconds + 1.5, distort) < np.inf
        assert lab.outputs[-1]["stopped_by"][0] & (Fault.JOINTS_IMPLAUSIBLE | Fault.TRACKING_ERROR)


def test_fingers_stopped_or_pushed_by_an_object_are_no_fault():
    """They close, squeeze, open and are pushed by 0.3 rad; one does not move at all."""
    lab = Lab().started()
    for closing in (0.2, 1.2, 0.6, 0.0, 1.5):
        lab.target[0, FINGERS] = HOME[FINGERS] + closing
        lab.is_held_fast[FINGERS] = closing > 0.5
        assert lab.run(0.3, noisy)["mode"][0] == Mode.RUN
    lab.is_held_fast[:] = False
    lab.run(0.5, noisy)
    lab.joint_pos[0, FINGERS] -= 0.08  # a tick later: no jump
    assert lab.run(0.3, noisy)["mode"][0] == Mode.RUN
    lab.is_held_fast[7] = True
    lab.target[0, FINGERS] = HOME[FINGERS] + 0.2
    assert lab.run(0.5)["mode"][0] == Mode.RUN


def test_a_finger_that_moves_without_a_command_stops_the_robot():
    """By 0.6 rad in 2 s, inside its travel."""
    lab = Lab().started()
    lab.target[0, FINGERS] = HOME[FINGERS] + 0.8
    lab.run(0.5)
    begin = lab.time

    def drifting(good: ServoInputs) -> ServoInputs:
        gone = 0.3 * (good.now[0] - begin) * (np.arange(NUM) == 18)
        return replace(good, joint_pos=good.joint_pos - gone)

    assert until_stopped(lab, 2.0, drifting) < np.inf
    assert lab.outputs[-1]["stopped_by"][0] == Fault.JOINTS_IMPLAUSIBLE
