"""Modes of the servo, faults, implausible positions, and the motion of commands from target to target."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from laws import OFF
from servo_rows import HOME, LIMITS, MISHAPS, Lab, all_at_once, given, noisy

from paper_robot import JOINTS
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.servo.limits import STOP_TIME, JointLimits
from pixel2catch.servo.link import Clamp, Fault, Mode, flag_names
from pixel2catch.servo.state import ServoInputs
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

STEP_TICKS = round(CONTROL_DT / LIMITS.dt) + 1
STOP_TICKS = round(STOP_TIME / LIMITS.dt)
YES, NO = np.array([True]), np.array([False])


def test_modes_follow_each_other_in_order():
    """An armed servo waits for images, and for an object that was never seen."""
    lab, stale = Lab(), given(image_stamp=np.array([0.0]), box_stamp=np.array([-np.inf]))
    assert np.isnan(lab.tick()["sent"]).all()
    assert lab.arm()["mode"] == Mode.ARMED
    assert lab.run(0.2, stale)["mode"] == Mode.ARMED
    np.testing.assert_allclose(lab.tick(stale)["sent"], HOME[None], atol=1e-12)
    assert lab.tick()["mode"] == Mode.RAMP
    lab.run(LIMITS.ramp_time - 2 * LIMITS.dt)
    assert lab.tick()["mode"] == Mode.RAMP
    lab.run(2 * LIMITS.dt)
    assert lab.tick()["mode"] == Mode.RUN
    assert lab.tick(given(is_stop_requested=YES))["mode"] == Mode.STOPPED


def test_the_ramp_moves_evenly_to_the_target():
    """Halfway through the ramp, the command is halfway between start pose and target."""
    lab = Lab()
    lab.target[0, 1] += 0.1
    lab.arm()
    output = lab.run(LIMITS.ramp_time / 2 + LIMITS.dt)
    assert output["sent"][0, 1] - HOME[1] == pytest.approx(0.05, abs=6e-3)
    assert lab.run(LIMITS.ramp_time)["sent"][0, 1] - HOME[1] == pytest.approx(0.1, abs=1e-12)


def test_a_target_is_reached_after_a_control_step_as_in_training():
    """The motion of training from 0 to 0.05 rad: even, except for the acceleration at its ends."""
    lab = Lab().started()
    while lab.state.robots["target_stamp"] != lab.state.robots["now"]:
        lab.tick()
    lab.run(CONTROL_DT - 2 * LIMITS.dt)
    lab.target[0, 0] += 0.05
    while lab.state.robots["target_stamp"] != lab.state.robots["now"]:
        lab.tick()
    commands = [
        lab.outputs[-1]["sent"][0, 0] - HOME[0],
        *(lab.tick()["sent"][0, 0] - HOME[0] for _ in range(STEP_TICKS)),
    ]
    ideal = 0.05 * np.minimum(np.arange(1, STEP_TICKS + 2) * LIMITS.dt / CONTROL_DT, 1.0)
    lag = 1.5**2 / (2 * LIMITS.joints.acceleration[0]) + 2 * 1.5 * LIMITS.dt
    assert (np.abs(np.array(commands) - ideal) <= lag).all()
    assert commands[-1] == pytest.approx(0.05, abs=1e-3)


def test_every_fault_stops_and_is_named():
    """In a fast motion; every stop ends in time, near the joints."""
    lab = Lab(len(MISHAPS)).swung()
    assert (np.abs(lab.state.joints["velocity"][:, :3]) > 3.0).all()
    output = lab.tick(all_at_once)
    assert (output["mode"] == Mode.STOPPED).all()
    for row, (fault, field, _) in enumerate(MISHAPS):
        found = int(output["stopped_by"][row])
        assert found & fault if field == "now" else found == fault, tuple(flag_names(Fault, found))
        assert str(fault.name).lower().replace("_", " ") in tuple(flag_names(Fault, found))
    commands = np.stack([output["sent"], *(lab.tick()["sent"] for _ in range(2 * STOP_TICKS))])
    is_silent = np.tile([fault == Fault.OTHER_PUBLISHER for fault, _, _ in MISHAPS], (len(commands), 1))
    is_silent[STOP_TICKS + 1 :] |= (output["stopped_by"] & OFF) != 0
    np.testing.assert_array_equal(np.isnan(commands), is_silent[:, :, None].repeat(len(JOINTS), axis=2))
    commands = np.where(np.isnan(commands), lab.state.joints["command"], commands)
    assert not np.diff(commands[STOP_TICKS:], axis=0).any()
    assert (np.abs(lab.joint_pos - commands[-1])[~is_silent[-1]] < 0.02).all()


def test_a_stopped_robot_that_was_moved_by_hand_is_armed_at_its_new_pose():
    lab = Lab().swung()
    lab.tick(given(is_stop_requested=YES))
    assert lab.run(2.0 * STOP_TIME)["mode"] == Mode.STOPPED
    homed = lab.joint_pos.copy()
    homed[0, 2] -= 0.1
    assert lab.tick(given(joint_pos=homed))["found"] == Fault.JOINTS_IMPLAUSIBLE  # so far in a tick
    assert lab.tick(given(joint_pos=homed))["mode"] == Mode.IDLE
    assert np.isnan(lab.outputs[-1]["sent"]).all()
    assert lab.run(0.1, given(joint_pos=homed))["mode"] == Mode.IDLE
    lab.joint_pos[:] = lab.target[:] = homed
    assert lab.arm()["mode"] == Mode.ARMED
    assert (np.abs(lab.outputs[-1]["sent"] - homed) < 1e-9).all()


def test_a_robot_that_another_program_moved_is_armed_at_its_new_pose():
    """Nothing was sent since the stop: commands may start anywhere."""
    lab = Lab().swung()
    lab.run(2.0 * STOP_TIME, given(has_other_publisher=~NO))
    lab.joint_pos[0, 2] -= 0.5 * (LIMITS.joints.start_error + LIMITS.joints.moved_error)[2]
    assert lab.tick()["mode"] == Mode.STOPPED
    assert lab.request_arm()["mode"] == Mode.ARMED
    np.testing.assert_allclose(lab.outputs[-1]["sent"], lab.last_inputs.joint_pos, atol=1e-9)


def test_a_far_first_target_stops():
    lab = Lab()
    lab.target[0, 1] += 0.6
    lab.arm()
    output = lab.tick()
    assert (output["mode"], output["stopped_by"]) == (Mode.STOPPED, Fault.TARGET_FAR)


def test_a_blocked_arm_stops():
    """Blocked fingers do not, see below."""
    lab = Lab().started()
    lab.is_held_fast[1] = True
    lab.target[0, 1] += 0.3
    lab.run(0.5, noisy)
    assert lab.outputs[-1]["stopped_by"] == Fault.TRACKING_ERROR


def test_a_command_stays_near_its_joint():
    """For any target, the joints are as fast as in training at most."""
    lab = Lab().started()
    lab.target[0, 0] -= 1.0
    speeds, leads = [], []
    for _ in range(100):
        before = lab.joint_pos[0, 0]
        output = lab.tick()
        speeds.append(abs(lab.joint_pos[0, 0] - before) / LIMITS.dt)
        leads.append(abs(output["sent"][0, 0] - before))
    assert any(output["clamped"] & Clamp.LEAD for output in lab.outputs)
    assert max(leads) <= LIMITS.joints.lead[0] + 1e-9
    assert 2.3 < max(speeds) < JOINTS[0].velocity_limit


def test_the_table_limits_only_joints_that_move_towards_it():
    """The elbow stops above the table, pan and fingers continue, and the elbow can return."""
    lab = Lab().started()
    lab.target[0, [0, 2, 8]] = HOME[0] + 0.2, HOME[2] + 0.8, 1.0
    output = lab.run(0.6)
    assert output["mode"] == Mode.RUN
    assert output["clamped"] & Clamp.WORKSPACE
    np.testing.assert_allclose(output["sent"][0, [0, 8]], lab.target[0, [0, 8]], atol=1e-6)
    assert 0.6 < output["sent"][0, 2] - HOME[2] < 0.75
    lab.target[0, 2] = HOME[2]
    np.testing.assert_allclose(lab.run(0.6)["sent"][0, 2], HOME[2], atol=1e-9)


SPEED_LIMITS = np.array([joint.velocity_limit for joint in JOINTS])


def lab_of_lag(lag: float, share: float, is_identified: bool, num_rows: int = 1) -> Lab:
    """Return a running lab whose joints have a lag, which is in the limits if it is identified."""
    dynamics = JointDynamics.of()
    if is_identified:
        dynamics = dynamics.with_values(stiffness=dynamics.damping / lag)
    joints = JointLimits.of(UR5E_ALLEGRO, share, dynamics, is_identified=is_identified)
    lab = Lab(num_rows, limits=replace(LIMITS, joints=joints)).started()
    lab.lag = np.full(len(JOINTS), lag)
    return lab


def fastest_in_swings(lab: Lab, num_swings: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest speeds of the arm's joints [rad/s] and the faults of each row in swings.

    A robot that was stopped is armed again.
    """
    fastest, faults = np.zeros(lab.joint_pos.shape), np.zeros(lab.rows, dtype=np.int64)
    for swing in range(num_swings):
        lab.target[:, [0, 3, 4, 5]] = HOME[[0, 3, 4, 5]] + (0.5 if swing % 2 else -0.5)
        for _ in range(60):
            before = lab.joint_pos.copy()
            lab.tick()
            fastest = np.maximum(fastest, np.abs(lab.joint_pos - before) / LIMITS.dt)
            faults |= lab.outputs[-1]["stopped_by"]
        if (lab.outputs[-1]["mode"] == Mode.STOPPED).any():
            lab.run(STOP_TIME)
            lab.target = lab.joint_pos.copy()
            lab.request_arm()
            lab.run(LIMITS.ramp_time + 0.05)
    return fastest[:, :6], faults


@pytest.mark.parametrize(
    ("lag", "share", "is_identified", "true_lags", "least"),
    [
        (0.02, 0.25, True, (1.0, 1.4, 1.0 / 3.0, 3.0), 0.75),
        (0.14, 1.0, True, (1.0, 1.4, 1.0 / 3.0, 3.0), 0.75),
        (0.02, 1.0, False, (1.0, 3.0, 7.0), 0.5),
    ],
)
def test_no_joint_is_faster_than_its_limit(lag, share, is_identified, true_lags, least):
    """The lag in the dynamics file is right, too short, too long or much too short; or not identified."""
    lab = lab_of_lag(lag, share, is_identified, num_rows=len(true_lags))
    lab.lag = lag * np.array(true_lags)[:, None]
    fastest, faults = fastest_in_swings(lab)
    assert (fastest <= share * SPEED_LIMITS[:6]).all(), fastest
    assert (fastest[:3, 0] > least * share * SPEED_LIMITS[0]).all()
    assert not faults[:3].any()


@pytest.mark.parametrize(
    ("lag", "share", "is_identified"),
    [(0.02, 1.0, True), (0.14, 0.25, True), (0.02, 0.25, False), (0.14, 1.0, False)],
)
def test_a_stop_slows_joints_evenly(lag: float, share: float, is_identified: bool):
    """From the largest speed, at about the deceleration of a stop."""
    lab = lab_of_lag(lag, share, is_identified)
    lab.target[0, [0, 3]] -= 1.0
    lab.run(0.15)
    positions = [lab.joint_pos[0, [0, 3]].copy()]
    for tick in range(STOP_TICKS):
        lab.tick(given(is_stop_requested=YES) if tick == 0 else None)
        positions.append(lab.joint_pos[0, [0, 3]].copy())
    speed = np.diff(positions, axis=0) / LIMITS.dt
    assert (np.abs(speed[0]) > 0.15 * share * SPEED_LIMITS[0]).all()
    hardest = np.abs(np.diff(speed, axis=0)).max() / LIMITS.dt
    assert hardest < 2.1 * lab.limits.joints.deceleration[0]
    assert np.abs(speed[-1]).max() < 0.06


def test_a_stop_without_positions_slows_commands_evenly():
    """From the speed of an identified arm, in the time of a stop."""
    lab = Lab().started()
    lab.target[0, 0] -= 1.0
    lab.run(0.15)
    commands = [lab.state.joints["command"][0, 0]]
    for _ in range(STOP_TICKS):
        commands.append(lab.tick(given(joint_pos=np.full((1, len(JOINTS)), np.nan)))["sent"][0, 0])
    speed = np.diff(commands) / LIMITS.dt
    stop_time, delay = (LIMITS.joint_records[name][0] for name in ("stop_time", "delay"))
    even = speed[0] * (1.0 - (np.arange(1, STOP_TICKS) * LIMITS.dt - delay) / stop_time).clip(0.0, 1.0)
    np.testing.assert_allclose(speed[1:], even, atol=0.05 * abs(speed[0]))
    assert speed[0] < -2.0


def test_a_stop_that_began_without_positions_does_not_go_back_to_them():
    """A joint that was measured 0.3 rad away in one tick is not used again in this stop."""
    lab = Lab().swung()
    before, speed = (lab.state.joints[name].copy() for name in ("command", "velocity"))
    lab.tick(given(joint_pos=lab.joint_pos + 0.3))
    assert lab.outputs[-1]["stopped_by"] & Fault.JOINTS_IMPLAUSIBLE
    way = (lab.run(STOP_TIME)["sent"] - before)[:, :3] * np.sign(speed[:, :3])
    assert (way > -1e-3).all()


def test_an_arm_that_is_moved_too_fast_stops():
    lab = Lab().swung()
    faults = 0
    for _ in range(50):
        lab.joint_pos[0, 0] += 1.25 * SPEED_LIMITS[0] * LIMITS.dt
        faults |= int(lab.tick()["stopped_by"][0])
    assert faults & Fault.JOINT_SPEED


ARM, FINGERS, ELBOW = range(6), range(6, len(HOME)), 2
NUM = len(HOME)
Distort = Callable[[ServoInputs], ServoInputs]


def measured(change: Callable[[np.ndarray], np.ndarray]) -> Distort:
    return lambda good: replace(good, joint_pos=change(good.joint_pos))


def frozen(joints: range | int) -> Distort:
    """Return a fault: joints repeat their position with new stamps."""
    kept, is_frozen = list[np.ndarray](), np.isin(np.arange(NUM), joints)

    def change(pos: np.ndarray) -> np.ndarray:
        kept.append(pos)
        return np.where(is_frozen, kept[0], pos)

    return measured(change)


def until_stopped(lab: Lab, seconds: float, distort: Distort) -> float:
    """Time until the robot stops [s]; infinite if it does not."""
    begin = lab.time
    while lab.time < begin + seconds:
        if lab.tick(distort)["mode"][0] == Mode.STOPPED:
            return lab.time - begin
    return np.inf


@pytest.mark.parametrize(
    ("joints", "motion", "seconds"),
    [(0, -0.02, 0.22), (ELBOW, -0.3, 0.22), (FINGERS, 0.3, 0.25), (8, 0.3, 0.25), (ARM, 0.008, np.inf)],
)
def test_a_frozen_measurement_stops_the_robot_when_its_joint_is_to_move(
    joints: range | int, motion: float, seconds: float
):
    """Also with a small target; 0.008 rad is less than what shows it."""
    lab = Lab().started()
    lab.target[0, joints] += motion
    time = until_stopped(lab, 1.0, frozen(joints))
    assert time <= seconds
    assert np.isfinite(time) == np.isfinite(seconds)
    assert (
        lab.outputs[-1]["stopped_by"][0] & ~(Fault.JOINTS_FROZEN | Fault.TRACKING_ERROR | Fault.HAND_ASTRAY)
        == 0
    )


EXCHANGED = np.array([*range(6), 9, 10, 11, 6, 7, 8, *range(12, NUM)])
HAND_FAULTS: dict[str, Distort] = {
    "limp": noisy,
    "two fingers exchanged": measured(lambda pos: pos[:, EXCHANGED]),
    "inverted": measured(lambda pos: np.where(np.arange(NUM) == 8, 2.0 * HOME - pos, pos)),
    "half the scale": measured(lambda pos: np.where(np.arange(NUM) == 8, (HOME + pos) / 2.0, pos)),
}


@pytest.mark.parametrize("fault", HAND_FAULTS)
def test_a_hand_that_does_not_follow_stops(fault: str):
    """Within 0.3 s of its first motion; once an object may hold it, fingers may stop."""
    lab = Lab().started()
    lab.is_held_fast[FINGERS] = fault == "limp"
    lab.target[0, FINGERS] += np.repeat((0.7, 0.2, 0.4), (3, 3, 7))
    assert until_stopped(lab, 0.5, HAND_FAULTS[fault]) < 0.3
    assert lab.outputs[-1]["stopped_by"][0] == Fault.HAND_ASTRAY


@pytest.mark.parametrize(("joints", "angle"), [(8, 0.09), (8, 0.06), (FINGERS, 0.09)])
def test_one_joint_alone_may_be_off_by_less_than_all_alike(joints: range | int, angle: float):
    """By 0.07 rad for 0.04 s; a swing of the arm drags several joints by up to 0.1 rad."""
    lab = Lab().started()
    lab.is_held_fast[joints] = True
    lab.target[0, joints] += angle
    assert (until_stopped(lab, 0.5, noisy) < 0.3) == (joints == 8 and angle > 0.07)


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
        assert lab.run(0.5, noisy)["mode"][0] == Mode.RUN
    lab.is_held_fast[:] = False
    lab.run(0.5, noisy)
    lab.joint_pos[0, FINGERS] -= 0.08  # a tick later: no jump
    assert lab.run(0.3, noisy)["mode"][0] == Mode.RUN
    lab.is_held_fast[7] = True
    lab.target[0, FINGERS] = HOME[FINGERS] + 0.2
    assert lab.run(0.5)["mode"][0] == Mode.RUN


@pytest.mark.parametrize("is_planned", [False, True])
def test_only_a_hand_that_a_policy_moves_must_be_free(is_planned: bool):
    """Fingers close on an object that they hold. Boxes are as new as the targets if clocks differ."""
    lab = Lab().started()
    lab.target[0, FINGERS] = HOME[FINGERS] + 0.2
    lab.is_held_fast[FINGERS] = True

    def planned(good: ServoInputs) -> ServoInputs:
        planned = np.full(lab.rows, is_planned)
        return replace(noisy(good), box_stamp=good.target_stamp, is_planned=planned)

    assert (lab.run(0.5, planned)["mode"][0] == Mode.RUN) == is_planned


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
