"""`pixel2catch excite`, as a user starts it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded import ROBOTS

from pixel2catch.cli.main import main
from pixel2catch.identification.checks import check_recording
from pixel2catch.identification.excitation import ExcitationCfg, draw_excitation
from pixel2catch.identification.importers import read_recording
from pixel2catch.identification.recording import Trajectory
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics

QUICK = ("excite", "--robot", "ur5e", "--seconds", "20")
ARM = ROBOTS["ur5e"]


def run(*args: object) -> int:
    return main([*QUICK, *map(str, args)])


def test_a_lively_robot_gets_less_motion_which_still_tells_every_joint(tmp_path: Path):
    """In a process of its own: it simulates for a minute, without the tests' checks of every call."""
    nominal = JointDynamics.nominal(ARM)
    DynamicsFile(dynamics=nominal.with_values(damping=0.5 * nominal.damping)).save(tmp_path / "lively.json")
    late = JointDynamics.nominal(("elbow_joint",)).with_values(latency=0.02)
    DynamicsFile(dynamics=late).save(tmp_path / "late.json")
    files = {
        "--dynamics": "lively.json",
        "--truth": "late.json",
        "--out": "new/motion.npz",
        "--picture": "motion.png",
        "--rehearse": "rehearsal",
    }
    options = [str(part) for name, file in files.items() for part in (name, tmp_path / file)]
    command = [sys.executable, "-m", "pixel2catch", *QUICK, "--speed", "1", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "trying less motion, because shoulder_pan_joint reaches 3." in done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"wrote {tmp_path / 'new' / 'motion.npz'}, ")
    for words in ("seed 0, simulated", "robot and table: never nearer", "hand and hand: 10.7 mm"):
        assert words in done.stdout
    assert done.stdout.count(" good ") == len(ARM)
    trajectory = Trajectory.load(tmp_path / "new" / "motion.npz")
    assert trajectory.header["shrunk"].keys() == set(ARM)
    drawn = draw_excitation(ExcitationCfg(robot="ur5e", seconds=20.0), {})
    np.testing.assert_array_less(np.ptp(trajectory.positions, axis=0), np.ptp(drawn.positions, axis=0))
    assert (tmp_path / "motion.png").read_bytes()[1:4] == b"PNG"
    recording = read_recording(tmp_path / "rehearsal" / "recording-1.npz", "ur5e")
    np.testing.assert_array_equal(recording.q_cmd, trajectory.at(recording.t_cmd))
    assert not [check for check in check_recording(recording) if check.is_good is False]
    truth = DynamicsFile.load(tmp_path / "rehearsal" / "truth.json").dynamics
    assert truth.latency.tolist() == [0.0, 0.0, 0.02, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("option", ["--out", "--picture", "--rehearse"])
def test_nothing_is_overwritten(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    kept = tmp_path / "old" / "file.npz"
    kept.parent.mkdir()
    kept.write_text("old")
    assert run(option, kept.parent if option == "--rehearse" else kept) == 2
    error = capsys.readouterr().err
    assert error.startswith("pixel2catch: error:")
    assert str(kept.parent) in error
    assert kept.read_text() == "old"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--speed", 2), "speed is 2; it must be greater than 0, and at most 1"),
        (("--recordings", 0), "recordings is 0"),
        (("--seconds", 5), "seconds is 5; at this speed it must be at least"),
        (("--physics-hz", 0), "physics_hz is 0"),
        (("--dynamics", "nowhere.json"), "nowhere.json"),
    ],
)
def test_wrong_options_say_what_is_right(
    options: tuple[object, ...], words: str, capsys: pytest.CaptureFixture[str]
):
    assert run(*options) == 2
    assert words in capsys.readouterr().err


def test_several_trajectories_are_numbered(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "motion-2.npz").write_text("old")
    assert run("--recordings", 2, "--out", tmp_path / "motion.npz") == 2
    assert "motion-2.npz exists" in capsys.readouterr().err
