"""Recordings and trajectories as files, and the motion that they refuse."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import ARM, ROBOTS, assert_same, clean, short

from paper_robot import ARM_JOINTS, HAND_JOINTS, JOINTS
from pixel2catch.errors import InvalidValueError, Pixel2CatchError, RecordingError, UnknownNameError
from pixel2catch.identification.recording import (
    REST,
    Recording,
    Trajectory,
    joints_of,
    largest_step,
    parts,
    require_motion,
)
from pixel2catch.workcells.ur5e_allegro import TWO_UR5E_ALLEGRO, UR5E_ALLEGRO


def test_parts_are_robots_groups_and_everything():
    assert list(parts(UR5E_ALLEGRO)) == ["ur5e", "allegro_left", "arm", "hand", "ur5e_allegro"]
    assert ROBOTS["ur5e"] + ROBOTS["allegro"] == ROBOTS["ur5e_allegro"] == tuple(spec.name for spec in JOINTS)
    assert joints_of(UR5E_ALLEGRO, "allegro") == joints_of(UR5E_ALLEGRO, "hand")
    assert joints_of(TWO_UR5E_ALLEGRO, "right_ur5e")[0] == "right_shoulder_pan_joint"
    with pytest.raises(UnknownNameError, match="Valid: left_ur5e"):
        joints_of(TWO_UR5E_ALLEGRO, "right")


def test_a_file_keeps_every_bit_and_is_not_overwritten(tmp_path: Path):
    path = tmp_path / "motion.npz"
    short().save(path)
    with pytest.raises(InvalidValueError, match="exists; name another file"):
        clean().save(path)
    assert_same(Recording.load(path), short())


def test_joints_are_found_by_name():
    backwards = short().select(ARM[::-1])
    assert backwards.joints == ARM[::-1]
    np.testing.assert_array_equal(backwards.q[:, 0], short().q[:, 5])
    assert_same(backwards.select(ARM), short())
    with pytest.raises(RecordingError, match=r"no joint index_joint_1; it has .* another --robot"):
        short().select(("index_joint_1",))


def test_joints_may_have_other_names_in_a_file(tmp_path: Path):
    arrays = {name: getattr(short(), name) for name in ("t_cmd", "q_cmd", "t_meas", "q")}
    theirs = [f"joint_{i}" for i in range(6)]
    np.savez(tmp_path / "motion.npz", joints=np.array(theirs), **arrays)
    read = Recording.load(tmp_path / "motion.npz", names=dict(zip(theirs, ARM, strict=True)))
    assert_same(read, short())
    with pytest.raises(RecordingError, match=r"motion\.npz: .* no joint joint_0, .* Rename these"):
        Recording.load(tmp_path / "motion.npz")
    np.savez(tmp_path / "motion.npz", joints=np.array(ARM), q=np.zeros((3, 6)))
    with pytest.raises(RecordingError, match=r"motion\.npz.*no array t_cmd, q_cmd, t_meas; a recording has"):
        Recording.load(tmp_path / "motion.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {"q": np.where(r.q == r.q[3, 2], np.nan, r.q)}, "q, row 3, column elbow_joint: nan"),
        (lambda r: {"t_meas": np.insert(r.t_meas[1:], 2, np.nan)}, "row 2, column time: nan"),
        (lambda r: {"t_cmd": r.t_cmd[::-1].copy()}, "q_cmd, row 1, column time: 0.3 s is before"),
        (lambda r: {"q": np.degrees(r.q)}, "row 0, column shoulder_pan_joint: 1.* in degrees, convert it"),
        (lambda r: {"q_cmd": r.q_cmd[:1], "t_cmd": r.t_cmd[:1]}, "no motion, .* two rows"),
        (lambda r: {"joints": ARM[:-1]}, "5 times and 5 joints"),
        (lambda _: {"joints": (*ARM[:2], "elbow", *ARM[3:])}, "'elbow'.*Did you mean 'elbow_joint'"),
    ],
)
def test_impossible_motion_is_refused(change, message: str):
    with pytest.raises(Pixel2CatchError, match=message):
        replace(short(), **change(short()))


def test_the_reach_is_that_of_an_arm_or_a_hand():
    """5 rad are possible for an elbow, not for a thumb."""
    time, positions = np.arange(3.0), np.full((3, 1), 5.0)
    require_motion("file", ("elbow_joint",), time, positions, UR5E_ALLEGRO)
    with pytest.raises(RecordingError, match=r"5 rad is farther than .* reach of 3\.14 rad; .* degrees"):
        require_motion("file", ("thumb_joint_1",), time, positions, UR5E_ALLEGRO)


MOVED = ("elbow_joint", "index_joint_1")
HOME = (ARM_JOINTS[2].home, HAND_JOINTS[0].home)


def arrays() -> tuple[np.ndarray, np.ndarray]:
    """A jump of 0.1 rad of both joints, there and back, at 10 Hz."""
    times = np.arange(41) / 10.0
    positions = np.tile(HOME, (41, 1))
    positions[15:25] += 0.1
    return times, positions


def trajectory(times: np.ndarray, positions: np.ndarray, joints: tuple[str, ...] = MOVED) -> Trajectory:
    return Trajectory(joints=joints, times=times, positions=positions, header={"seed": 7, "shrunk": {}})


def test_a_target_holds_until_the_next():
    found = trajectory(*arrays()).at(np.array([-1.0, 1.49, 1.5, 2.44, 2.5, 9.0]))
    np.testing.assert_allclose(found[:, 1], [0.0, 0.0, 0.1, 0.1, 0.0, 0.0])


def test_largest_step_by_hand():
    # 0.9 of 2.79253 rad/s, times 343 N·m·s/rad over 2536 N·m/rad; 0.9 of 7 rad/s, times 0.1 over 3
    assert largest_step(ARM_JOINTS[2]) == pytest.approx(0.33993, abs=1e-5)
    assert largest_step(HAND_JOINTS[0]) == pytest.approx(0.21)


def test_a_trajectory_file_keeps_every_bit(tmp_path: Path):
    written = trajectory(*arrays())
    written.save(tmp_path / "motion.npz")
    read = Trajectory.load(tmp_path / "motion.npz")
    assert (read.joints, read.header) == (MOVED, {"seed": 7, "shrunk": {}})
    np.testing.assert_array_equal(read.times, written.times)
    np.testing.assert_array_equal(read.positions, written.positions)


def spoiled(fault: str) -> Trajectory:
    times, positions = arrays()
    rows, columns, change = {
        "limit": (slice(15, 25), 1, np.linspace(0.0, 1.7, 10)),
        "jump": (slice(15, 25), 0, 0.25),
        "no rest": (slice(5, 15), slice(None), 0.05),
        "no return": (slice(25, None), slice(None), 0.1),
    }.get(fault, (0, 0, 0.0))
    positions[rows, columns] += change
    row, change = {"twice": (20, -0.1), "late": (slice(None), 0.5)}.get(fault, (0, 0.0))
    times[row] += change
    end = 15 if fault == "short" else None
    return trajectory(times[:end], positions[:end], MOVED[::-1] if fault == "order" else MOVED)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("limit", r"row 23, column index_joint_1: 1\.6111\d* rad is beyond the joint's limits"),
        ("jump", r"row 15, column elbow_joint: 2\.444\d* rad is farther from the row above"),
        ("twice", r"row 20, column time: 1\.9 s"),
        ("late", r"row 0, column time: 0\.5 s"),
        ("no rest", r"row 5, column elbow_joint: .* must be at rest"),
        ("no return", r"row 30, column elbow_joint: .* must be at rest"),
        ("short", rf"it lasts 1\.4 s; it needs {REST:g} s of rest at each end"),
        ("order", "in the order"),
    ],
)
def test_a_trajectory_that_a_robot_should_not_follow_is_refused(fault: str, words: str):
    with pytest.raises(Pixel2CatchError, match=words):
        spoiled(fault)


def test_a_trajectory_of_another_format_is_refused(tmp_path: Path):
    times, positions = arrays()
    header = '{"format_version": 2}'
    np.savez(tmp_path / "motion.npz", joints=MOVED, times=times, positions=positions, header=header)
    with pytest.raises(InvalidValueError, match=r"motion\.npz.*format_version is 2"):
        Trajectory.load(tmp_path / "motion.npz")
