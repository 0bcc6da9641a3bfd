"""Options that say what a lab calls topics and joints."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import ARM, assert_same, short

from pixel2catch.errors import InvalidValueError, Pixel2CatchError, RecordingError, UnknownNameError
from pixel2catch.identification.importers import CommandTopic, Names, read_recording
from pixel2catch.identification.robot import ROBOTS

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
