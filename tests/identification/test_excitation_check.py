"""The trial in simulation: torques, distances and limits, against numbers worked out by hand."""

import numpy as np
import pytest

from pixel2catch.identification.rehearsal import RULES, assess, clearances
from pixel2catch.identification.robot import JOINT_SPECS
from pixel2catch.identification.trajectory import Trajectory
from pixel2catch.robot.joint_dynamics import JointDynamics

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


def test_a_jump_takes_stiffness_times_its_size():
    step = moved("index_joint_3", np.full(60, 0.05))
    share = assess(step, JointDynamics.nominal(step.joints)).torque_share[0]
    # 3 N·m/rad times 0.05 rad of 0.5 N·m, less what damping takes in the first 2 ms of a time constant of 11
    assert 0.8 * 0.3 < share <= 0.3


def test_a_large_jump_reaches_the_torque_limit_and_not_more():
    step = moved("elbow_joint", np.full(60, 0.3))
    assert assess(step, JointDynamics.nominal(step.joints)).torque_share[0] == pytest.approx(0.999, abs=1e-6)


def test_slow_motion_takes_friction_only():
    # at 0.1 rad/s tanh(1) of 0.01 N·m, of 0.5; a target 0.8 mrad from the last adds up to 3 N·m/rad of that
    ramp = np.minimum(np.arange(250), np.arange(250)[::-1]) * 0.1 / 125.0
    slow = moved("index_joint_3", ramp)
    share = assess(slow, JointDynamics.nominal(slow.joints)).torque_share[0]
    friction = np.tanh(1.0) * 0.01
    assert friction / 0.5 < share < (friction + 3.0 * 0.0008) / 0.5


def test_the_start_pose_keeps_all_distances():
    time, position = pose()
    table, arm, hand = clearances(list(JOINT_SPECS), time, position)
    assert all(each.is_kept for each in (table, arm, hand))
    assert np.isinf(table.distance)
    assert table.sentence() == "robot and table: never nearer than 100 mm"
    # the thumb's third link, 27.5 mm wide, stands beside the palm
    assert hand.distance == pytest.approx(0.010725, abs=1e-6)
    assert set(hand.bodies) == {"palm", "thumb_link_2"}


def test_a_folded_arm_is_too_near_to_itself_and_to_the_table():
    near = clearances(list(JOINT_SPECS), *pose(elbow_joint=3.0))
    assert [each.is_kept for each in near] == [False, False, True]
    assert set(near[1].bodies) == {"upper_arm_link", "wrist_1_link"}


def test_a_thumb_in_the_palm_is_too_near():
    near = clearances(list(JOINT_SPECS), *pose(thumb_joint_2=1.6, thumb_joint_3=1.7))
    assert [each.is_kept for each in near] == [True, True, False]
    assert set(near[2].bodies) == {"thumb_link_3", "palm"}


def test_an_arm_that_bends_down_is_stopped_above_the_table():
    down = moved("shoulder_lift_joint", there_and_back(1.8, 4.0))
    (fault,) = [
        fault for fault in assess(down, JointDynamics.nominal(down.joints)).faults if "table" in fault.text
    ]
    assert fault.joints == ("shoulder_lift_joint",)
    assert "50 mm are to be kept" in fault.text
    assert 0.0 < fault.remedy < 1.0


def test_a_hand_that_is_too_near_shrinks_the_hand_alone():
    joints = ("elbow_joint", "thumb_joint_2", "thumb_joint_3")
    positions = np.tile([JOINT_SPECS[name].home for name in joints], (450, 1))
    positions[130:-130, 1:] += 1.6 * there_and_back(1.0, 190 / 125)[:, None]
    thumb = Trajectory(joints=joints, times=np.arange(450) / 125.0, positions=positions)
    (fault,) = assess(thumb, JointDynamics.nominal(joints)).faults
    assert fault.joints == joints[1:]


def test_a_joint_that_is_too_fast_is_told_by_how_much():
    ramp = np.minimum(np.minimum(np.arange(90), np.arange(90)[::-1]) * 3.4 / 125.0, 1.0)
    fast = moved("shoulder_pan_joint", ramp)
    assessment = assess(fast, JointDynamics.nominal(fast.joints))
    (fault,) = assessment.faults
    assert fault.text.startswith("shoulder_pan_joint reaches 3.")
    assert fault.remedy == pytest.approx(0.95 * 2.79253 / assessment.speed[0])


def test_rules_are_in_the_order_of_the_pairs():
    assert [rule.is_of_hand for rule in RULES] == [False, False, True]
