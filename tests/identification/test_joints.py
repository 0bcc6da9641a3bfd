"""Any work cell can be identified: parts by name, what hangs on what, and nothing too near at the start."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from recorded import short, write_rtde

from pixel2catch.errors import RecordingError, UnknownNameError
from pixel2catch.identification.excitation import ExcitationCfg, draw_excitation
from pixel2catch.identification.importers import read_recording
from pixel2catch.identification.joints import joints_of, parts, recorded_model, specs_of
from pixel2catch.identification.recording import Recording, Trajectory
from pixel2catch.identification.rehearsal import clearances
from pixel2catch.identification.simulation import RecordedMotion
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.workcells import find_workcell, workcells
from pixel2catch.workcells.ur5e_allegro import TWO_UR5E_ALLEGRO, UR5E_ALLEGRO

CELLS = list(workcells().values())


def test_parts_are_robots_groups_and_everything():
    assert list(parts(UR5E_ALLEGRO)) == ["ur5e", "allegro_left", "arm", "hand", "ur5e_allegro"]
    assert joints_of(UR5E_ALLEGRO, "allegro") == joints_of(UR5E_ALLEGRO, "hand")
    assert joints_of(TWO_UR5E_ALLEGRO, "right_ur5e")[0] == "right_shoulder_pan_joint"
    with pytest.raises(UnknownNameError, match="Valid: left_ur5e"):
        joints_of(TWO_UR5E_ALLEGRO, "right")


@pytest.mark.parametrize("workcell", CELLS, ids=lambda cell: cell.name)
def test_the_start_pose_is_near_nothing_that_moves_away(workcell: WorkcellSpec):
    names = [joint.name for joint in workcell.joints]
    home = np.array([[joint.home for joint in workcell.joints]])
    near = clearances(names, np.zeros(1), home, workcell)
    assert [each.is_kept for each in near] == [True, True, True], [each.sentence() for each in near]


@pytest.mark.parametrize("workcell", CELLS, ids=lambda cell: cell.name)
def test_an_excitation_of_every_part_can_be_written_and_read(workcell: WorkcellSpec, tmp_path: Path):
    for number, part in enumerate(parts(workcell)):
        drawn = draw_excitation(ExcitationCfg(workcell=workcell, robot=part, seconds=30.0), {})
        drawn.save(tmp_path / f"{number}.npz")
        read = Trajectory.load(tmp_path / f"{number}.npz")
        assert (read.workcell, read.joints) == (workcell, joints_of(workcell, part))


def test_a_joint_moves_its_own_chain_and_what_hangs_on_it():
    joints = tuple(joint.name for joint in TWO_UR5E_ALLEGRO.joints)
    home = np.tile([joint.home for joint in TWO_UR5E_ALLEGRO.joints], (100, 1))
    time = 0.01 * np.arange(100.0)
    recording = Recording(
        workcell=TWO_UR5E_ALLEGRO, joints=joints, t_cmd=time, q_cmd=home, t_meas=time, q=home
    )
    coupled = RecordedMotion([recording]).coupled
    elbow, index = (joints.index(f"left_{name}") for name in ("elbow_joint", "index_joint_2"))
    assert coupled[elbow].tolist() == [name.startswith("left_") for name in joints]
    assert coupled[index].tolist() == [name.startswith("left_index") for name in joints]


def test_logs_of_an_arm_are_those_of_the_arm_of_the_work_cell(tmp_path: Path):
    folder = write_rtde(tmp_path / "run", short())
    release = find_workcell("ur5e_allegro_release")
    assert read_recording(folder, "arm", workcell=release).joints == short().joints
    with pytest.raises(RecordingError, match="no column q_6"):
        read_recording(folder, "arm", workcell=find_workcell("fr3_allegro"))


@pytest.mark.parametrize("joint", ["shoulder_pan_joint", "elbow_joint", "wrist_1_joint", "index_joint_2"])
def test_a_joint_alone_moves_what_it_moves_in_the_start_pose(joint: str) -> None:
    """As one of all joints, which stand there, by MuJoCo; at zero the pan moves six times as much."""
    inertias = []
    for names in (tuple(specs_of(UR5E_ALLEGRO)), (joint,)):
        model = recorded_model(UR5E_ALLEGRO, names, 0.002)
        data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        data.qpos[:] = [specs_of(UR5E_ALLEGRO)[name].home for name in names]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        inertias.append(inertia[names.index(joint), names.index(joint)])
    assert inertias[1] == pytest.approx(inertias[0], rel=1e-6)
