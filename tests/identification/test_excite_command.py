"""`pixel2catch excite`: the trajectories and recordings that it writes."""

from pathlib import Path

import numpy as np
import pytest
from recorded import ROBOTS

from pixel2catch.cli.main import main
from pixel2catch.identification.recording import Recording, Trajectory
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics


def run(*args: object) -> int:
    return main(["excite", "--seconds", "14", *map(str, args)])


def test_a_trajectory_and_its_rehearsal_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    late = JointDynamics.nominal(ROBOTS["allegro"]).with_values(latency=0.02)
    DynamicsFile(dynamics=late).save(tmp_path / "late.json")
    options = ("--dynamics", tmp_path / "late.json", "--out", tmp_path / "new" / "motion.npz")
    assert run("--robot", "allegro", "--seconds", "20", *options, "--rehearse", tmp_path / "reh") == 0
    assert "robot and table: never closer" in capsys.readouterr().out
    trajectory = Trajectory.load(tmp_path / "new" / "motion.npz")
    recording = Recording.load(tmp_path / "reh" / "recording-1.npz")
    np.testing.assert_array_equal(recording.q_cmd, trajectory.at(recording.t_cmd))
    assert DynamicsFile.load(tmp_path / "reh" / "truth.json").dynamics == late


def test_without_dynamics_several_rehearsals_share_a_truth_unlike_the_nominal_robot(tmp_path: Path):
    assert (
        run("--robot", "allegro", "--seconds", "20", "--recordings", "2", "--rehearse", tmp_path / "new") == 0
    )
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["recording-1.npz", "recording-2.npz", "truth.json"]
    truth, nominal = (
        DynamicsFile.load(tmp_path / "new" / "truth.json").dynamics,
        JointDynamics.nominal(ROBOTS["allegro"]),
    )
    for name in ("stiffness", "damping", "frictionloss", "armature"):
        ratio = getattr(truth, name) / getattr(nominal, name)
        assert 0.7 <= ratio.min() < 0.9
        assert 1.1 < ratio.max() <= 1.4
    assert (truth.latency == 0.012).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--seconds", 5), "seconds is 5; at this speed it must be at least"),
        (("--recordings", 2, "--out", "motion.npz"), "motion-2.npz exists"),
        (("--rehearse", "."), "is not an empty folder"),
    ],
)
def test_wrong_options_are_named_and_nothing_is_overwritten(
    options: tuple[object, ...],
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(tmp_path)
    Path("motion-2.npz").write_text("old")
    assert run("--robot", "ur5e", *options) == 2
    assert words in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["motion-2.npz"]
