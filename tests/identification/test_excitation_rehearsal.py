"""`excite`: distances and limits of the simulated robot, what it records, and the files of the command."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import JOINT_SPECS, ROBOTS, short

from pixel2catch.cli.main import main
from pixel2catch.identification import excitation
from pixel2catch.identification.recording import Recording, Trajectory
from pixel2catch.identification.rehearsal import Assessment, assess, clearances
from pixel2catch.identification.simulation import FIT_DT
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

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


def test_the_start_pose_keeps_all_distances():
    time, position = pose()
    table, arm, hand = clearances(list(JOINT_SPECS), time, position, UR5E_ALLEGRO)
    assert all(each.is_kept for each in (table, arm, hand))
    assert np.isinf(table.distance)
    assert table.sentence() == "robot and table: never closer than 100 mm"
    # the thumb's third link, 27.5 mm wide, stands beside the palm
    assert hand.distance == pytest.approx(0.010725, abs=1e-6)
    assert set(hand.bodies) == {"palm", "thumb_link_2"}


def test_a_folded_arm_is_too_near_to_itself_and_to_the_table():
    near = clearances(list(JOINT_SPECS), *pose(elbow_joint=3.0), UR5E_ALLEGRO)
    assert [each.is_kept for each in near] == [False, False, True]
    assert set(near[1].bodies) == {"upper_arm_link", "wrist_1_link"}


def test_an_arm_that_bends_down_is_stopped_above_the_table():
    down = moved("shoulder_lift_joint", there_and_back(1.8, 4.0))
    found = assess(down, JointDynamics.nominal().select(down.joints)).violations
    (violation,) = (each for each in found if "table" in each.text)
    assert violation.joints == ("shoulder_lift_joint",)
    assert "keep 50 mm" in violation.text
    assert 0.0 < violation.remedy < 1.0


def test_a_hand_that_is_too_near_shrinks_the_hand_alone():
    joints = ("elbow_joint", "thumb_joint_2", "thumb_joint_3")
    positions = np.tile([JOINT_SPECS[name].home for name in joints], (450, 1))
    positions[130:-130, 1:] += 1.6 * there_and_back(1.0, 190 / 125)[:, None]
    thumb = Trajectory(joints=joints, times=np.arange(450) / 125.0, positions=positions)
    (violation,) = assess(thumb, JointDynamics.nominal().select(joints)).violations
    assert violation.joints == joints[1:]


def test_a_joint_that_is_too_fast_is_told_by_how_much():
    ramp = np.minimum(np.minimum(np.arange(90), np.arange(90)[::-1]) * 3.4 / 125.0, 1.0)
    fast = moved("shoulder_pan_joint", ramp)
    assessment = assess(fast, JointDynamics.nominal().select(fast.joints))
    (violation,) = assessment.violations
    assert violation.text.startswith("shoulder_pan_joint reaches 3.")
    top = np.abs(np.diff(assessment.recording.q, axis=0)).max() / FIT_DT
    assert violation.remedy == pytest.approx(0.95 * 2.79253 / top)


def test_the_time_at_the_torque_limit_is_that_of_jumps():
    """After a jump of 0.3 rad the elbow's servo requests 5 times its torque; a slow motion needs less."""
    spec = JOINT_SPECS["elbow_joint"]
    nominal = JointDynamics.nominal().select(("elbow_joint",))
    assert 0.3 * spec.stiffness > 5.0 * spec.effort_limit
    slow = assess(moved("elbow_joint", there_and_back(0.3, 4.0)), nominal)
    jump = assess(moved("elbow_joint", np.full(125, 0.3)), nominal)
    assert slow.at_torque_limit == {}
    assert 0.0 < jump.at_torque_limit["elbow_joint"] < 0.2


def run(*args: object, seconds: int = 14) -> int:
    return main(["excite", "--seconds", str(seconds), *map(str, args)])


def test_a_trajectory_and_its_rehearsal_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    late = JointDynamics.nominal().select(ROBOTS["allegro"]).with_values(latency=0.02)
    DynamicsFile(dynamics=late).save(tmp_path / "late.json")
    options = ("--dynamics", tmp_path / "late.json", "--out", tmp_path / "new" / "motion.npz")
    assert run("--robot", "allegro", *options, "--rehearse", tmp_path / "reh", seconds=20) == 0
    assert "robot and table: never closer" in capsys.readouterr().out
    trajectory = Trajectory.load(tmp_path / "new" / "motion.npz")
    recording = Recording.load(tmp_path / "reh" / "recording-1.npz")
    np.testing.assert_array_equal(recording.q_cmd, trajectory.at(recording.t_cmd))
    assert DynamicsFile.load(tmp_path / "reh" / "truth.json").dynamics == late


def test_without_dynamics_several_rehearsals_share_a_truth_unlike_the_nominal_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Trajectories are taken as they are drawn; the test above assesses them."""
    sound = Assessment(recording=short(), clearances=(), checks=(), violations=())
    monkeypatch.setattr(excitation, "assess", lambda *_: sound)
    options = ("--recordings", "2", "--rehearse", tmp_path / "new")
    assert run("--robot", "ur5e", *options, seconds=20) == 0
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["recording-1.npz", "recording-2.npz", "truth.json"]
    truth = DynamicsFile.load(tmp_path / "new" / "truth.json").dynamics
    ratio = truth.stiffness / JointDynamics.nominal().select(ROBOTS["ur5e"]).stiffness
    assert 0.7 <= ratio.min() < 0.9 < 1.1 < ratio.max() <= 1.4
    assert (truth.latency == 0.012).all()


def test_wrong_options_are_named_and_nothing_is_overwritten(tmp_path: Path, monkeypatch, refusal: Any):
    monkeypatch.chdir(tmp_path)
    Path("motion-2.npz").write_text("old")
    for options, words in (
        (("--recordings", 2, "--out", "motion.npz"), "'motion-2.npz', which exists"),
        (("--rehearse", "."), "is not an empty folder"),
    ):
        assert words in refusal("excite", "--robot", "ur5e", "--seconds", 14, *options)
        assert [path.name for path in tmp_path.iterdir()] == ["motion-2.npz"]
