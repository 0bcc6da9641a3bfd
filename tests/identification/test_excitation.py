"""`excite`: signals and their envelope; distances and limits of the simulated robot; files of the command."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorded import JOINT_SPECS, ROBOTS, short

from pixel2catch.cli.main import main
from pixel2catch.errors import InvalidValueError, UnknownNameError
from pixel2catch.identification import excitation
from pixel2catch.identification.excitation import (
    RATE,
    Envelope,
    ExcitationCfg,
    Signal,
    approach,
    draw_excitation,
    multisine,
    policy_targets,
    slow_reversals,
    steps,
    turns,
)
from pixel2catch.identification.recording import Recording, Trajectory, joints_of, largest_step, parts
from pixel2catch.identification.rehearsal import Assessment, Violation, assess, clearances
from pixel2catch.identification.simulation import FIT_DT
from pixel2catch.mdp.dynamics_file import DynamicsFile
from pixel2catch.robots.joint_dynamics import JointDynamics
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells import workcells
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

WHOLE = ExcitationCfg(seconds=20.0, seed=0)
JOINTS = ROBOTS["ur5e_allegro"]
ROUNDING = 1e-9
SEEDS, SPEEDS = st.integers(0, 2**31), st.floats(0.05, 1.0)
FEW = settings(max_examples=10)


def test_it_begins_and_ends_in_the_start_pose_and_has_all_kinds_of_motion():
    trajectory = draw_excitation(WHOLE, {})
    assert trajectory.joints == JOINTS
    assert trajectory.duration == pytest.approx(20.0)
    home = [spec.home for spec in JOINT_SPECS.values()]
    np.testing.assert_allclose(trajectory.positions[[0, -1]], [home, home])
    segments = trajectory.header["segments"]
    assert list(segments) == ["multisine", "steps", "policy_targets", "turns", "slow_reversals"]
    assert (np.diff(np.array(list(segments.values())).ravel()) > 0.0).all()
    for start, end in segments.values():
        inside = trajectory.positions[(trajectory.times >= start) & (trajectory.times < end)]
        assert (np.ptp(inside, axis=0) > 0.005).all()


def test_impossible_drawings_are_refused():
    with pytest.raises(UnknownNameError, match="Did you mean 'ur5e'"):
        ExcitationCfg(robot="ur5")
    with pytest.raises(InvalidValueError, match="seconds is 10; at this speed it must be at least 2"):
        draw_excitation(ExcitationCfg(seconds=10.0), {})
    assert draw_excitation(ExcitationCfg(seconds=21.0), {}).duration == pytest.approx(21.0)


@pytest.mark.parametrize("workcell", workcells().values(), ids=lambda cell: cell.name)
def test_every_part_of_every_work_cell_can_be_excited(workcell: WorkcellSpec):
    """The start pose keeps all distances, and trajectories of all parts are ones that a robot can follow."""
    names = [joint.name for joint in workcell.joints]
    home = np.array([[joint.home for joint in workcell.joints]])
    near = clearances(names, np.zeros(1), home, workcell)
    assert all(each.is_kept for each in near), [each.sentence() for each in near]
    for part in parts(workcell):
        drawn = draw_excitation(ExcitationCfg(workcell=workcell, robot=part, seconds=30.0), {})
        assert (drawn.workcell, drawn.joints) == (workcell, joints_of(workcell, part))


def test_joints_that_violate_a_limit_move_less(monkeypatch: pytest.MonkeyPatch):
    def judged(trajectory: Trajectory, _: JointDynamics) -> Assessment:
        violation = Violation(text="the index finger is too fast", joints=("index_joint_1",), remedy=0.5)
        violations = () if trajectory.header["shrunk"] else (violation,)
        return Assessment(recording=short(), clearances=(), checks=(), violations=violations)

    monkeypatch.setattr(excitation, "assess", judged)
    said: list[str] = []
    trajectory, _ = excitation.find_excitation(WHOLE, JointDynamics.of().select(JOINTS), said.append)
    assert said == ["trying less motion: the index finger is too fast"]
    index = JOINTS.index("index_joint_1")
    full = np.ptp(draw_excitation(WHOLE, {}).positions, axis=0)
    less = np.ptp(trajectory.positions, axis=0)
    assert less[index] < 0.6 * full[index]
    np.testing.assert_allclose(np.delete(less, index), np.delete(full, index))


def draw(signal: Signal, seed: int, speed: float, num_times: int = 500) -> tuple[Envelope, np.ndarray]:
    envelope = Envelope.of(JOINTS, speed, {}, UR5E_ALLEGRO)
    return envelope, signal(np.random.default_rng(seed), envelope, num_times)


def peaks(offsets: np.ndarray) -> np.ndarray:
    """Largest offset, change and change of change of each joint, per second."""
    return np.array([np.abs(np.diff(offsets, n, axis=0)).max(axis=0) * RATE**n for n in range(3)])


@FEW
@given(seed=SEEDS, speed=SPEEDS)
def test_signals_stay_in_their_envelope_and_return_to_the_middle(seed: int, speed: float):
    for signal in (multisine, slow_reversals, policy_targets, steps, turns):
        envelope, offsets = draw(signal, seed, speed)
        top, top_speed, top_acceleration = peaks(offsets)
        assert offsets.shape == (500, len(JOINTS))
        np.testing.assert_allclose(offsets[[0, -1]], 0.0, atol=ROUNDING)
        assert (top <= envelope.swing + ROUNDING).all()
        assert np.ptp(offsets, axis=0).min() > 0.0
        if signal in (multisine, slow_reversals, policy_targets):
            assert (top_speed <= envelope.speed + ROUNDING).all()
        else:
            assert (top_speed / RATE <= envelope.step + ROUNDING).all()
        if signal in (multisine, slow_reversals):
            assert (top_acceleration <= envelope.acceleration + 1e-6).all()
        if signal is multisine:  # each joint reaches one of its limits
            limits = np.array([envelope.swing, envelope.speed, envelope.acceleration])
            np.testing.assert_allclose((peaks(offsets) / limits).max(axis=0), 1.0)


@FEW
@given(seed=SEEDS, speed=SPEEDS)
def test_steps_are_large_and_many_and_turns_move_one_joint_of_a_limb_at_a_time(seed: int, speed: float):
    envelope, offsets = draw(steps, seed, speed, 1000)
    jumps = np.abs(np.diff(offsets, axis=0))
    assert (jumps.max(axis=0) >= 0.5 * np.minimum(envelope.step, envelope.swing)).all()
    assert (np.count_nonzero(jumps, axis=0) >= 8).all()
    is_moving = draw(turns, seed, speed, 750)[1] != 0.0
    for prefix in ("shoulder|elbow|wrist", "index", "middle", "ring", "thumb"):
        columns = [i for i, name in enumerate(JOINTS) if name.startswith(tuple(prefix.split("|")))]
        assert (np.count_nonzero(is_moving[:, columns], axis=1) <= 1).all(), prefix
    assert is_moving.any(axis=0).all()


def test_approach_goes_smoothly_from_the_start_pose_to_the_middle():
    envelope = Envelope.of(JOINTS, 0.1, {}, UR5E_ALLEGRO)
    offsets = approach(envelope)
    np.testing.assert_allclose(envelope.center + offsets[0], envelope.home)
    np.testing.assert_allclose(offsets[-1], 0.0, atol=ROUNDING)
    _, top_speed, top_acceleration = peaks(offsets)
    assert (top_speed <= envelope.speed).all()
    assert (top_acceleration <= envelope.acceleration).all()
    assert (np.abs(np.diff(offsets, axis=0))[[0, -1]] < 1e-4).all()


def test_envelope_by_hand():
    envelope = Envelope.of(JOINTS, 0.5, {"elbow_joint": 0.8}, UR5E_ALLEGRO)
    elbow, wrist, thumb = (JOINTS.index(name) for name in ("elbow_joint", "wrist_2_joint", "thumb_joint_0"))
    # the elbow is far from its limits: 80 % of 0.35 rad about its start pose, 40 % of everything else
    assert envelope.swing[elbow] == pytest.approx(0.28)
    assert envelope.center[elbow] == JOINT_SPECS["elbow_joint"].home
    assert envelope.acceleration[elbow] == pytest.approx(6.0)
    assert envelope.step[elbow] == pytest.approx(0.4 * largest_step(JOINT_SPECS["elbow_joint"]))
    # wrist 2 has 20 degrees: the middle of them, and 0.03 rad from each end
    assert envelope.center[wrist] == pytest.approx(np.radians(-100.0))
    assert envelope.swing[wrist] == pytest.approx(np.radians(10.0) - 0.03)
    # the thumb's first joint starts at its lower limit of 0.263 rad
    assert envelope.center[thumb] == pytest.approx(0.263 + 0.06 + 0.4)


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
    found = assess(down, JointDynamics.of().select(down.joints)).violations
    (violation,) = (each for each in found if "table" in each.text)
    assert violation.joints == ("shoulder_lift_joint",)
    assert "keep 50 mm" in violation.text
    assert 0.0 < violation.remedy < 1.0


def test_a_hand_that_is_too_near_shrinks_the_hand_alone():
    joints = ("elbow_joint", "thumb_joint_2", "thumb_joint_3")
    positions = np.tile([JOINT_SPECS[name].home for name in joints], (450, 1))
    positions[130:-130, 1:] += 1.6 * there_and_back(1.0, 190 / 125)[:, None]
    thumb = Trajectory(joints=joints, times=np.arange(450) / 125.0, positions=positions)
    (violation,) = assess(thumb, JointDynamics.of().select(joints)).violations
    assert violation.joints == joints[1:]


def test_a_joint_that_is_too_fast_is_told_by_how_much():
    ramp = np.minimum(np.minimum(np.arange(90), np.arange(90)[::-1]) * 3.4 / 125.0, 1.0)
    fast = moved("shoulder_pan_joint", ramp)
    assessment = assess(fast, JointDynamics.of().select(fast.joints))
    (violation,) = assessment.violations
    assert violation.text.startswith("shoulder_pan_joint reaches 3.")
    top = np.abs(np.diff(assessment.recording.q, axis=0)).max() / FIT_DT
    assert violation.remedy == pytest.approx(0.95 * 2.79253 / top)


def test_the_time_at_the_torque_limit_is_that_of_jumps():
    """After a jump of 0.3 rad the elbow's servo requests 5 times its torque; a slow motion needs less."""
    spec = JOINT_SPECS["elbow_joint"]
    nominal = JointDynamics.of().select(("elbow_joint",))
    assert 0.3 * spec.stiffness > 5.0 * spec.effort_limit
    slow = assess(moved("elbow_joint", there_and_back(0.3, 4.0)), nominal)
    jump = assess(moved("elbow_joint", np.full(125, 0.3)), nominal)
    assert slow.at_torque_limit == {}
    assert 0.0 < jump.at_torque_limit["elbow_joint"] < 0.2


def run(*args: object, seconds: int = 14) -> int:
    return main(["excite", "--seconds", str(seconds), *map(str, args)])


def test_a_trajectory_and_its_rehearsal_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    late = JointDynamics.of().select(ROBOTS["allegro"]).with_values(latency=0.02)
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
    ratio = truth.stiffness / JointDynamics.of().select(ROBOTS["ur5e"]).stiffness
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
