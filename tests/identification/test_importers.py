"""Logs of RTDE: both clocks survive, errors name file, line and column; options for the names of a lab."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import ARM, ROBOTS, assert_same, edit_line, short, write_rtde

from pixel2catch.errors import InvalidValueError, Pixel2CatchError, RecordingError, UnknownNameError
from pixel2catch.identification.importers import CommandTopic, Names, read_recording


@pytest.mark.parametrize("separator", [",", ", ", " "])
def test_both_logs_are_read(separator: str, tmp_path: Path):
    folder = write_rtde(tmp_path / "run", short(), separator)
    assert_same(read_recording(folder, "ur5e"), replace(short(), effort=None))


def test_speeds_are_optional(tmp_path: Path):
    folder = write_rtde(tmp_path / "run", short())
    edit_line(folder / "rtde.csv", 1, lambda line: line.replace("actual_qd", "other"))
    assert_same(read_recording(folder, "ur5e"), replace(short(), effort=None, qd=None))


def test_byte_order_mark_and_trailing_lines_do_no_harm(tmp_path: Path):
    folder = write_rtde(tmp_path / "run", short())
    for path in folder.iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_text().replace("\n", "\r\n").encode() + b"\r\n\r\n")
    assert_same(read_recording(folder, "ur5e"), replace(short(), effort=None))


def cell(column: int, value: str):
    return lambda line: ",".join(value if i == column else c for i, c in enumerate(line.split(",")))


@pytest.mark.parametrize(
    ("name", "line", "edit", "message"),
    [
        ("rtde.csv", 4, cell(3, "nan"), "rtde.csv, line 4, column elbow_joint: nan is no number; cut"),
        ("rtde.csv", 5, cell(1, "abc"), "rtde.csv, line 5, column actual_q_0: 'abc' is no number; correct"),
        (
            "rtde.csv",
            6,
            cell(0, "-1"),
            "rtde.csv, line 6: time runs backwards, -1.000000 s after 0.140000 s; split",
        ),
        ("rtde.csv", 7, cell(2, "90"), "rtde.csv, line 7, column shoulder_lift_joint: 90 rad .* radians"),
        ("rtde.csv", 12, lambda line: line[:40], "rtde.csv, line 12: . columns instead of 14; cor"),
        ("rtde.csv", 1, cell(0, "time"), "rtde.csv: no column timestamp; it has time, actual_q_0, "),
        ("commands.csv", 1, cell(3, "q_9"), "commands.csv: no column q_2; it has t, q_0, q_1, q_9"),
        ("commands.csv", 3, cell(6, ""), "commands.csv, line 3, column q_5: '' is no number"),
        ("commands.csv", 3, cell(6, "-200"), "commands.csv, line 3, column wrist_3_joint: -200 rad is"),
    ],
)
def test_error_names_file_line_and_fix(name: str, line: int, edit, message: str, tmp_path: Path):
    folder = write_rtde(tmp_path / "run", short())
    edit_line(folder / name, line, edit)
    with pytest.raises(RecordingError, match=message):
        read_recording(folder, "ur5e")


@pytest.mark.parametrize("content", ["", "\n\n", "t,q_0,q_1,q_2,q_3,q_4,q_5\n"])
def test_empty_log_is_refused(content: str, tmp_path: Path):
    folder = write_rtde(tmp_path / "run", short())
    (folder / "commands.csv").write_text(content)
    with pytest.raises(RecordingError, match=r"commands\.csv: empty, .*; record again"):
        read_recording(folder, "ur5e")


def test_missing_or_binary_log_is_refused(tmp_path: Path):
    folder = write_rtde(tmp_path / "run", short())
    (folder / "commands.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match=r"cannot read the table .*commands\.csv"):
        read_recording(folder, "ur5e")
    (folder / "commands.csv").unlink()
    with pytest.raises(RecordingError, match=r"commands\.csv.*No such file"):
        read_recording(folder, "ur5e")


def test_arm_logs_have_no_hand(tmp_path: Path):
    folder = write_rtde(tmp_path / "run", short())
    with pytest.raises(RecordingError, match=r"no joint index_joint_1, .*choose another --robot"):
        read_recording(folder, "ur5e_allegro")
    assert np.array_equal(read_recording(folder, "ur5e").t_cmd, short().t_cmd)


THEIRS = [f"joint_{i}" for i in range(6)]
RENAMES = [f"{ours}={theirs}" for ours, theirs in zip(ARM, THEIRS, strict=True)]


def parse(topics: Sequence[str] = (), renames: Sequence[str] = ()) -> Names:
    return Names.parse(topics, "/joint_states", renames)


def test_topics_say_which_joints_their_numbers_are_of():
    names = parse(["/arm=ur5e", "/hand=a,index_joint_1,spare", "/all"], ["thumb_joint_0=a"])
    assert names.command_topics == (
        CommandTopic(name="/arm", joints=ROBOTS["ur5e"]),
        CommandTopic(name="/hand", joints=("thumb_joint_0", "index_joint_1", "spare")),
        CommandTopic(name="/all"),
    )


def test_names_are_swapped_and_never_mistaken():
    swapped = parse(renames=["elbow_joint=wrist_1_joint", "wrist_1_joint=elbow_joint"])
    assert swapped.ours(["elbow_joint", "wrist_1_joint", "wrist_2_joint"]) == (
        "wrist_1_joint",
        "elbow_joint",
        "wrist_2_joint",
    )
    assert "elbow_joint" not in parse(renames=["elbow_joint=e"]).ours(["elbow_joint"])


@pytest.mark.parametrize(
    ("topics", "renames", "error", "message"),
    [
        ([], ["elbow=e"], UnknownNameError, "Did you mean 'elbow_joint'"),
        ([], ["elbow_joint"], InvalidValueError, "OURS=THEIRS, such as"),
        ([], ["elbow_joint=e", "elbow_joint=f"], InvalidValueError, "--rename names elbow_joint twice"),
        ([], ["elbow_joint=e", "wrist_1_joint=e"], InvalidValueError, "--rename names e twice"),
        (["/a", "/a=ur5e"], [], InvalidValueError, "--command-topic names /a twice"),
    ],
)
def test_wrong_options_say_what_is_right(topics, renames, error: type[Pixel2CatchError], message: str):
    with pytest.raises(error, match=message):
        parse(topics, renames)


def test_a_canonical_file_may_have_other_names(tmp_path: Path):
    recording, path = short(), tmp_path / "motion.npz"
    arrays = {name: getattr(recording, name) for name in ("t_cmd", "q_cmd", "t_meas", "q")}
    np.savez(path, joints=np.array(THEIRS), **arrays)
    with pytest.raises(RecordingError, match=r"motion\.npz: joint_0, .* no joints of ours; rename them"):
        read_recording(path, "ur5e")
    assert_same(
        read_recording(path, "ur5e", parse(renames=RENAMES)), replace(recording, qd=None, effort=None)
    )
