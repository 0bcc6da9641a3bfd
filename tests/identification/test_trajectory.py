"""The trajectory file: what is refused, because a robot would be let loose on it."""

from pathlib import Path

import numpy as np
import pytest

from paper_robot import ARM_JOINTS, HAND_JOINTS
from pixel2catch.errors import InvalidValueError, Pixel2CatchError, UnknownNameError
from pixel2catch.identification.joints import largest_step
from pixel2catch.identification.recording import REST, Trajectory

JOINTS = ("elbow_joint", "index_joint_1")
HOME = (ARM_JOINTS[2].home, HAND_JOINTS[0].home)


def arrays() -> tuple[np.ndarray, np.ndarray]:
    """A jump of 0.1 rad of both joints, there and back, at 10 Hz."""
    times = np.arange(41) / 10.0
    positions = np.tile(HOME, (41, 1))
    positions[15:25] += 0.1
    return times, positions


def trajectory(times: np.ndarray, positions: np.ndarray, joints: tuple[str, ...] = JOINTS) -> Trajectory:
    return Trajectory(joints=joints, times=times, positions=positions, header={"seed": 7, "shrunk": {}})


def test_a_target_holds_until_the_next():
    found = trajectory(*arrays()).at(np.array([-1.0, 1.49, 1.5, 2.44, 2.5, 9.0]))
    np.testing.assert_allclose(found[:, 1], [0.0, 0.0, 0.1, 0.1, 0.0, 0.0])


def test_largest_step_by_hand():
    # 0.9 of 2.79253 rad/s, times 343 N·m·s/rad over 2536 N·m/rad; 0.9 of 7 rad/s, times 0.1 over 3
    assert largest_step(ARM_JOINTS[2]) == pytest.approx(0.33993, abs=1e-5)
    assert largest_step(HAND_JOINTS[0]) == pytest.approx(0.21)


def test_what_is_written_is_read(tmp_path: Path):
    written = trajectory(*arrays())
    written.save(tmp_path / "motion.npz")
    read = Trajectory.load(tmp_path / "motion.npz")
    assert (read.joints, read.header) == (JOINTS, {"seed": 7, "shrunk": {}})
    np.testing.assert_array_equal(read.times, written.times)
    np.testing.assert_array_equal(read.positions, written.positions)
    before = (tmp_path / "motion.npz").read_bytes()
    with pytest.raises(InvalidValueError, match="exists"):
        written.save(tmp_path / "motion.npz")
    assert (tmp_path / "motion.npz").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["motion.npz"]


def spoiled(fault: str) -> Trajectory:
    times, positions = arrays()
    rows, columns, change = {
        "limit": (slice(15, 25), 1, np.linspace(0.0, 1.7, 10)),
        "jump": (slice(15, 25), 0, 0.25),
        "number": (20, 1, np.nan),
        "no rest": (slice(5, 15), slice(None), 0.05),
        "no return": (slice(25, None), slice(None), 0.1),
    }.get(fault, (0, 0, 0.0))
    positions[rows, columns] += change
    row, change = {"backwards": (20, -1.0), "twice": (20, -0.1), "late": (slice(None), 0.5)}.get(
        fault, (0, 0.0)
    )
    times[row] += change
    end = 15 if fault == "short" else None
    return trajectory(times[:end], positions[:end])


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("limit", r"target 23 .* of index_joint_1, 1\.6111 rad, is beyond the joint's limits"),
        ("jump", r"target 15 \(1\.500 s\) of elbow_joint, 2\.4444 rad, is farther from the target before"),
        ("number", "row 20, column index_joint_1: nan is no number"),
        ("backwards", "row 20: time runs backwards"),
        ("twice", r"target 20 is due at 1\.9 s"),
        ("late", r"target 0 is due at 0\.5 s"),
        ("no rest", r"target 5 \(0\.500 s\) of elbow_joint, .* parts from the start pose"),
        ("no return", r"target 30 \(3\.000 s\) of elbow_joint, .* parts from the start pose"),
        ("short", rf"it lasts 1\.4 s; it needs {REST:g} s of rest at each end"),
    ],
)
def test_what_a_robot_should_not_follow_is_refused(fault: str, words: str):
    with pytest.raises(Pixel2CatchError, match=words):
        spoiled(fault)


def test_joints_are_known_and_in_order():
    times, positions = arrays()
    with pytest.raises(UnknownNameError, match="Did you mean 'elbow_joint'"):
        trajectory(times, positions, ("elbow_joints", "index_joint_1"))
    with pytest.raises(InvalidValueError, match="in the order"):
        trajectory(times, positions, JOINTS[::-1])


def test_bad_files_are_refused_with_their_name(tmp_path: Path):
    path = tmp_path / "motion.npz"
    path.write_text("times,positions\n")
    with pytest.raises(InvalidValueError, match=r"motion\.npz.*pixel2catch excite"):
        Trajectory.load(path)
    with pytest.raises(InvalidValueError, match=r"nowhere\.npz"):
        Trajectory.load(tmp_path / "nowhere.npz")
    good = trajectory(*arrays())
    for header, words in (
        ('{"format_version": 2}', "format_version is 2"),
        ("{", r"motion\.npz"),
        ("[]", r"motion\.npz"),
    ):
        np.savez(path, joints=JOINTS, times=good.times, positions=good.positions, header=header)
        with pytest.raises(InvalidValueError, match=words):
            Trajectory.load(path)
    np.savez(path, joints=JOINTS, times=good.times, positions=good.positions)
    with pytest.raises(InvalidValueError, match="header"):
        Trajectory.load(path)
    np.savez(
        path, joints=JOINTS, times=good.times, positions=good.positions + 3.0, header='{"format_version": 1}'
    )
    with pytest.raises(InvalidValueError, match="beyond the joint's limits"):
        Trajectory.load(path)
