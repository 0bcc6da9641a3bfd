"""A recording keeps what was recorded, and refuses what no robot can have done."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import ARM, ROBOTS, assert_same, short

from paper_robot import JOINTS
from pixel2catch.errors import InvalidValueError, Pixel2CatchError, RecordingError, UnknownNameError
from pixel2catch.identification.importers import read_recording
from pixel2catch.identification.recording import Place, Recording, require_motion


def with_cell(values: np.ndarray, row: int, column: int, value: float) -> np.ndarray:
    changed = values.copy()
    changed[row, column] = value
    return changed


def test_robots_are_the_joints_of_the_agents():
    assert ROBOTS["ur5e"] + ROBOTS["allegro"] == ROBOTS["ur5e_allegro"] == tuple(spec.name for spec in JOINTS)


def test_canonical_file_keeps_every_bit(tmp_path: Path):
    recording = short()
    recording.save(tmp_path / "motion.npz")
    assert_same(Recording.load(tmp_path / "motion.npz"), recording)
    without = replace(recording, qd=None, effort=None)
    without.save(tmp_path / "positions.npz")
    assert_same(read_recording(tmp_path / "positions.npz", "ur5e"), without)


def test_saving_overwrites_nothing(tmp_path: Path):
    path = tmp_path / "motion.npz"
    path.write_bytes(b"precious")
    with pytest.raises(InvalidValueError, match="exists; choose another name"):
        short().save(path)
    assert path.read_bytes() == b"precious"


def test_joints_are_found_by_name(tmp_path: Path):
    recording = short()
    backwards = recording.select(ARM[::-1])
    assert backwards.joints == ARM[::-1]
    np.testing.assert_array_equal(backwards.q[:, 0], recording.q[:, 5])
    backwards.save(tmp_path / "motion.npz")
    assert_same(read_recording(tmp_path / "motion.npz", "ur5e"), recording)
    with pytest.raises(RecordingError, match=r"no joint index_joint_1, .* recorded are .* another --robot"):
        read_recording(tmp_path / "motion.npz", "allegro")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {"q": with_cell(r.q, 3, 2, np.nan)}, "q, qd, effort, row 3, column elbow_joint: nan"),
        (lambda r: {"effort": with_cell(r.effort, 4, 0, np.inf)}, "row 4, column shoulder_pan_joint: inf"),
        (lambda r: {"q_cmd": with_cell(r.q_cmd, 1, 5, np.nan)}, "q_cmd, row 1, column wrist_3_joint: nan"),
        (lambda r: {"t_meas": with_cell(r.t_meas[:, None], 2, 0, np.nan)[:, 0]}, "row 2, column time: nan"),
        (lambda r: {"t_cmd": r.t_cmd[::-1].copy()}, "q_cmd, row 1: time runs backwards, 0.3"),
        (lambda r: {"q": np.degrees(r.q)}, "row 0, column shoulder_pan_joint: 1.* convert it to radians"),
        (lambda r: {"q_cmd": r.q_cmd[:1], "t_cmd": r.t_cmd[:1]}, "no motion, .* two rows"),
        (lambda r: {"joints": ARM[:-1]}, "5 times and 5 joints need"),
    ],
)
def test_impossible_motion_is_refused(change, message: str):
    recording = short()
    with pytest.raises(RecordingError, match=message):
        replace(recording, **change(recording))


def test_a_row_too_few_is_refused():
    recording = short()
    with pytest.raises(RecordingError, match=r"shape \(10, 6\), but 11 times and 6 joints need \(11, 6\)"):
        require_motion(Place(source="arm"), ARM, recording.t_meas, recording.q, recording.q[:-1])


def test_unknown_joint_is_named():
    with pytest.raises(UnknownNameError, match=r"'elbow'.*Did you mean 'elbow_joint'"):
        replace(short(), joints=(*ARM[:2], "elbow", *ARM[3:]))


def test_hand_in_degrees_is_refused_although_an_arm_may_stand_there():
    motion = {"t_cmd": np.arange(3.0), "t_meas": np.arange(3.0), "q": np.full((3, 1), 5.0)}
    arm = Recording(joints=("elbow_joint",), q_cmd=motion["q"], **motion)
    with pytest.raises(RecordingError, match=r"5 rad is beyond the joint's reach of 3\.14 rad; .* degrees"):
        replace(arm, joints=("thumb_joint_1",))


def write_text(path: Path) -> None:
    path.write_text("hello")


def write_nothing(path: Path) -> None:
    path.touch()


def write_halves(path: Path) -> None:
    np.savez(path, joints=np.array(ARM), q=np.zeros((3, 6)))


def write_objects(path: Path) -> None:
    np.savez(path, joints=np.array(ARM), t_cmd=np.array([{}, None]), q_cmd=1, t_meas=1, q=1)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (write_text, "motion.npz.: it is no whole npz file"),
        (write_nothing, "it is no whole npz file"),
        (write_halves, "no array t_cmd, q_cmd, t_meas; a recording has"),
        (write_objects, "it has an array of object"),
    ],
)
def test_broken_canonical_file_is_refused(write, message: str, tmp_path: Path):
    write(tmp_path / "motion.npz")
    with pytest.raises(RecordingError, match=message) as caught:
        read_recording(tmp_path / "motion.npz", "ur5e")
    assert str(tmp_path / "motion.npz") in str(caught.value)


@pytest.mark.parametrize(
    ("name", "robot", "message"),
    [
        ("none.npz", "ur5e", "there is no such file"),
        ("notes.txt", "ur5e", "unknown format; a recording is an .npz file .* rosbag2"),
        (".", "ur5e", "unknown format"),
        ("log.parquet", "ur5e", "parquet is not read; save its columns with numpy.savez"),
        ("notes.txt", "ur5", "unknown robot 'ur5'. Did you mean 'ur5e'"),
    ],
)
def test_unknown_input_is_refused(name: str, robot: str, message: str, tmp_path: Path):
    for file in ("notes.txt", "log.parquet"):
        (tmp_path / file).write_text("hello")
    with pytest.raises(Pixel2CatchError, match=message) as caught:
        read_recording(tmp_path / name, robot)
    assert robot == "ur5" or re.escape(str(tmp_path)) in re.escape(str(caught.value))
