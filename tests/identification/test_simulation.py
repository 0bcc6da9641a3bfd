"""The forward model of the fit: the simulator that a policy trains in, with delayed commands."""

import mujoco
import numpy as np
import pytest
from recorded import JOINT_SPECS, ROBOTS

from pixel2catch.errors import RecordingError
from pixel2catch.identification.recording import Recording
from pixel2catch.identification.simulation import (
    FIT_DT,
    RecordedMotion,
    behind_play,
    recorded_model,
    step_commands,
)
from pixel2catch.robots.joint_dynamics import DryFriction, JointDynamics
from pixel2catch.workcells.ur5e_allegro import TWO_UR5E_ALLEGRO, UR5E_ALLEGRO

DT = 1.0 / 240.0
ALL = ROBOTS["ur5e_allegro"]


def held_steps(joints: tuple[str, ...], seconds: float = 0.8, size: float = 0.07) -> Recording:
    """A new command every 0.1 s, sent where a physics step takes it up whole; the robot is at its start."""
    rng = np.random.default_rng(3)
    home = np.array([JOINT_SPECS[name].home for name in joints])
    t_meas = np.arange(round(seconds / DT) + 1) * DT
    t_cmd = np.arange(0, len(t_meas), 24) * DT - DT / 2
    q_cmd = home + rng.uniform(0.0, size, (len(t_cmd), len(joints)))
    return Recording(
        joints=joints, t_cmd=t_cmd, q_cmd=q_cmd, t_meas=t_meas, q=np.tile(home, (len(t_meas), 1))
    )


def simulated(recording: Recording, dynamics: JointDynamics, dt: float = DT) -> np.ndarray:
    return RecordedMotion([recording], dt).simulate([dynamics])[0]


def test_the_time_step_hardly_matters():
    """Large steps of the command drive the joints to their torque limits."""
    recording = held_steps(("shoulder_pan_joint", "wrist_3_joint"), size=0.5)
    dynamics = JointDynamics.of().select(recording.joints).with_values(latency=0.004)
    coarse, fine = (simulated(recording, dynamics, dt) for dt in (FIT_DT, FIT_DT / 8))
    assert np.sqrt(np.mean((coarse - fine) ** 2, axis=0)).max() < 1.5e-4


def test_candidates_and_recordings_do_not_mix():
    """Alone or together with others, longer ones among them, a motion is the same."""
    short, long = held_steps(("elbow_joint",)), held_steps(("elbow_joint",), 1.0)
    nominal = JointDynamics.of().select(short.joints)
    slow = nominal.with_values(damping=2 * nominal.damping, latency=0.01)
    both = RecordedMotion([short, long], DT).simulate([nominal, slow])
    for i, dynamics in enumerate((nominal, slow)):
        alone = [simulated(recording, dynamics) for recording in (short, long)]
        np.testing.assert_allclose(both[i], np.concatenate(alone), atol=1e-12)


def test_useless_recordings_are_refused():
    elbow, wrist = held_steps(("elbow_joint",)), held_steps(("wrist_1_joint",))
    with pytest.raises(RecordingError, match="at least one"):
        RecordedMotion([])
    with pytest.raises(RecordingError, match="too short"):
        RecordedMotion([held_steps(("elbow_joint",), 0.5)])
    with pytest.raises(RecordingError, match="same joints"):
        RecordedMotion([elbow, wrist])


def test_a_step_has_the_commands_before_and_after_a_jump():
    """A command 0 → 1 at 0.1 s arrives at 0.112 s: it holds for 8 of the 10 ms from 0.11 s.

    Three commands in one step, 0, 1 and 5 for 2, 4 and 4 ms, keep their mean.
    """
    edges, latency = np.array((0.10, 0.11, 0.12, 0.13)), np.array((0.012,))
    t_cmd, q_cmd = np.array((0.0, 0.1)), np.array(((0.0,), (1.0,)))
    first, jump, last = step_commands(t_cmd, q_cmd, edges, latency)[..., 0]
    np.testing.assert_allclose(jump, (0.8, -0.8, 0.2, 0.2), atol=1e-9)
    np.testing.assert_allclose((first[:3], last[:3]), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), atol=1e-9)
    t_cmd, q_cmd = np.array((0.0, 0.1, 0.104)), np.array(((0.0,), (1.0,), (5.0,)))
    crowded = step_commands(t_cmd, q_cmd, edges, latency)[1, :, 0]
    np.testing.assert_allclose(crowded[0], 0.2 * 0.0 + 0.4 * 1.0 + 0.4 * 5.0)


def test_dry_friction_holds_up_to_its_bound():
    """Of 0.4 N·m on 0.14 kg·m² and in steps of 1/240 s: a grip of 8,064 N·m/rad, bent by 50 µrad."""
    grip = 0.14 * 240**2
    friction = DryFriction(np.array([[0.4]]), np.array([[0.14]]), np.zeros((1, 1)), 1 / 240)
    positions = np.array((2e-5, 4e-5, 1e-3, 0.99e-3, 0.5e-3))
    torques = [float(friction.torque(np.array([[position]]))[0, 0]) for position in positions]
    np.testing.assert_allclose(torques, (-2e-5 * grip, -4e-5 * grip, -0.4, -0.4 + 1e-5 * grip, 0.4))


def test_encoders_behind_play_stay_behind():
    """Half a play of 2 mrad behind the joint, whichever way it moves, and still while it crosses the play."""
    positions = np.array((0.0, 0.5, 3.0, 2.0, 1.0, 0.0))[:, None] * 1e-3
    expected = np.array((0.0, 0.0, 2.0, 2.0, 2.0, 1.0))[:, None] * 1e-3
    np.testing.assert_allclose(behind_play(positions, np.array([2e-3])), expected)


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


@pytest.mark.parametrize("joint", ["shoulder_pan_joint", "index_joint_2"])
def test_a_joint_alone_moves_what_it_moves_in_the_start_pose(joint: str):
    """By MuJoCo, as one of all joints in the start pose; with all at zero the pan moves six times as much."""
    inertias = []
    for names in (ALL, (joint,)):
        model = recorded_model(UR5E_ALLEGRO, names, 0.002)
        data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        data.qpos[:] = [JOINT_SPECS[name].home for name in names]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        inertias.append(inertia[names.index(joint), names.index(joint)])
    assert inertias[1] == pytest.approx(inertias[0], rel=1e-6)
