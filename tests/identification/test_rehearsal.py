"""The simulated robot: its torques, distances and limits, and what it records, against numbers by hand."""

from pathlib import Path

import numpy as np
import pytest
from recorded import JOINT_SPECS, ROBOTS

from pixel2catch.identification.recording import Recording, Trajectory
from pixel2catch.identification.rehearsal import (
    PERFECT,
    STALLED_TURN,
    Recorder,
    assess,
    clearances,
    rehearse,
    simulated_recordings,
    turns_of_a_loop,
    unlike_nominal,
)
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics

HOME = np.array([spec.home for spec in JOINT_SPECS.values()])


def moved(joint: str, offsets: np.ndarray) -> Trajectory:
    """Offsets of one joint at 125 Hz, between rests of a second."""
    offsets = np.pad(offsets, 130)
    times = np.arange(len(offsets)) / 125.0
    return Trajectory(joints=(joint,), times=times, positions=JOINT_SPECS[joint].home + offsets[:, None])


def there_and_back(angle: float, seconds: float) -> np.ndarray:
    return angle * np.sin(np.pi / 2 * np.sin(np.linspace(0.0, np.pi, int(125 * seconds)))) ** 2


def pose(**angles: float) -> tuple[np.ndarray, np.ndarray]:
    """One time and one pose: the start pose but for some joints."""
    position = HOME.copy()
    for name, angle in angles.items():
        position[list(JOINT_SPECS).index(name)] = angle
    return np.zeros(1), position[None]


def test_a_jump_takes_stiffness_times_its_size():
    step = moved("index_joint_3", np.full(60, 0.05))
    share = assess(step, JointDynamics.nominal(step.joints)).torque_share[0]
    # 3 N·m/rad times 0.05 rad of 0.5 N·m, less what damping takes in the first 2 ms of a time constant of 11
    assert 0.8 * 0.3 < share <= 0.3


def test_a_large_jump_reaches_the_torque_limit_and_not_more():
    step = moved("elbow_joint", np.full(60, 0.3))
    assert assess(step, JointDynamics.nominal(step.joints)).torque_share[0] == pytest.approx(0.999, abs=1e-6)


def test_slow_motion_takes_friction_only():
    # 0.01 N·m of 0.5; a target 0.8 mrad from the last adds up to 3 N·m/rad of that, slipping some
    ramp = np.minimum(np.arange(250), np.arange(250)[::-1]) * 0.1 / 125.0
    slow = moved("index_joint_3", ramp)
    share = assess(slow, JointDynamics.nominal(slow.joints)).torque_share[0]
    assert 0.01 / 0.5 < share < (0.01 + 3.0 * 0.001) / 0.5


def test_the_start_pose_keeps_all_distances():
    time, position = pose()
    table, arm, hand = clearances(list(JOINT_SPECS), time, position)
    assert all(each.is_kept for each in (table, arm, hand))
    assert np.isinf(table.distance)
    assert table.sentence() == "robot and table: never closer than 100 mm"
    # the thumb's third link, 27.5 mm wide, stands beside the palm
    assert hand.distance == pytest.approx(0.010725, abs=1e-6)
    assert set(hand.bodies) == {"palm", "thumb_link_2"}


def test_a_folded_arm_is_too_near_to_itself_and_to_the_table():
    near = clearances(list(JOINT_SPECS), *pose(elbow_joint=3.0))
    assert [each.is_kept for each in near] == [False, False, True]
    assert set(near[1].bodies) == {"upper_arm_link", "wrist_1_link"}


def test_a_thumb_in_the_palm_is_too_near():
    near = clearances(list(JOINT_SPECS), *pose(thumb_joint_2=1.6, thumb_joint_3=1.7))
    assert [each.is_kept for each in near] == [True, True, False]
    assert set(near[2].bodies) == {"thumb_link_3", "palm"}


def test_an_arm_that_bends_down_is_stopped_above_the_table():
    down = moved("shoulder_lift_joint", there_and_back(1.8, 4.0))
    (violation,) = [
        violation
        for violation in assess(down, JointDynamics.nominal(down.joints)).violations
        if "table" in violation.text
    ]
    assert violation.joints == ("shoulder_lift_joint",)
    assert "keep 50 mm" in violation.text
    assert 0.0 < violation.remedy < 1.0


def test_a_hand_that_is_too_near_shrinks_the_hand_alone():
    joints = ("elbow_joint", "thumb_joint_2", "thumb_joint_3")
    positions = np.tile([JOINT_SPECS[name].home for name in joints], (450, 1))
    positions[130:-130, 1:] += 1.6 * there_and_back(1.0, 190 / 125)[:, None]
    thumb = Trajectory(joints=joints, times=np.arange(450) / 125.0, positions=positions)
    (violation,) = assess(thumb, JointDynamics.nominal(joints)).violations
    assert violation.joints == joints[1:]


def test_a_joint_that_is_too_fast_is_told_by_how_much():
    ramp = np.minimum(np.minimum(np.arange(90), np.arange(90)[::-1]) * 3.4 / 125.0, 1.0)
    fast = moved("shoulder_pan_joint", ramp)
    assessment = assess(fast, JointDynamics.nominal(fast.joints))
    (violation,) = assessment.violations
    assert violation.text.startswith("shoulder_pan_joint reaches 3.")
    assert violation.remedy == pytest.approx(0.95 * 2.79253 / assessment.speed[0])


JOINTS = ("elbow_joint", "index_joint_2")
START = (2 / 3 * np.pi, 0.0)


def bump(size: float) -> Trajectory:
    """A smooth motion there and back."""
    times = np.arange(401) / 125.0
    positions = np.tile(START, (401, 1))
    positions[130:260] += size * np.sin(np.linspace(0.0, np.pi, 130))[:, None] ** 2
    return Trajectory(joints=JOINTS, times=times, positions=positions)


def record(cfg: Recorder, *sizes: float, seed: int = 0, **truth: float) -> list[Recording]:
    dynamics = JointDynamics.nominal(JOINTS).with_values(**truth)
    return simulated_recordings([bump(size) for size in sizes], dynamics, cfg, np.random.default_rng(seed))


def test_turns_of_a_loop_are_even_or_stalled():
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(turns_of_a_loop(rng, 0.05, 0.01, 0.0), [0.0, 0.01, 0.02, 0.03, 0.04])
    turns = turns_of_a_loop(rng, 400.0, 0.008, 0.05)
    lengths = np.diff(turns)
    is_stalled = np.isclose(lengths, STALLED_TURN)
    assert (is_stalled | np.isclose(lengths, 0.008)).all()
    assert is_stalled.mean() == pytest.approx(0.05, abs=0.005)
    assert 399.9 < turns[-1] < 400.0


def test_both_loops_stall_each_in_its_own_time():
    (recording,) = record(Recorder(), 0.2)
    sent, read = (time[:-1][np.diff(time) > 0.03] for time in (recording.t_cmd, recording.t_meas))
    assert min(len(sent), len(read)) > 3
    assert not np.isin(np.round(sent, 2), np.round(read, 2)).all()
    np.testing.assert_array_equal(recording.q_cmd, bump(0.2).at(recording.t_cmd))


def test_each_recording_follows_its_own_trajectory_and_returns():
    small, large = record(PERFECT, 0.05, 0.2)
    for recording, size in ((small, 0.05), (large, 0.2)):
        np.testing.assert_allclose(recording.q[[0, -1]], [START, START], atol=3.4e-3)
        # friction holds the finger 0.01 / 3 rad short of its start
        # the finger, whose servo takes 33 ms, nearly gets there; the arm, with 135 ms, does not
        elbow, finger = np.ptp(recording.q, axis=0) / size
        assert 0.6 < elbow < 0.95
        assert 0.92 < finger < 1.0


def test_a_rehearsal_writes_recordings_and_the_truth(tmp_path: Path):
    truth = unlike_nominal(np.random.default_rng(5), JointDynamics.nominal(JOINTS))
    rehearse(tmp_path / "new", [bump(0.1), bump(0.2)], truth, seed=0)
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["recording-1.npz", "recording-2.npz", "truth.json"]
    assert DynamicsFile.load(tmp_path / "new" / "truth.json").dynamics == truth
    ranges = [np.ptp(Recording.load(tmp_path / "new" / name).q[:, 1]) for name in names[:2]]
    np.testing.assert_allclose(ranges, [0.1, 0.2], rtol=0.1)


def test_truth_is_unlike_the_nominal_robot():
    nominal = JointDynamics.nominal(ROBOTS["ur5e_allegro"])
    truth = unlike_nominal(np.random.default_rng(0), nominal)
    for name in ("stiffness", "damping", "frictionloss", "armature"):
        ratio = getattr(truth, name) / getattr(nominal, name)
        assert 0.7 <= ratio.min() < 0.9
        assert 1.1 < ratio.max() <= 1.4
    assert (truth.latency == 0.012).all()
