"""Actions to joint targets: one affine map, anchored at the measured position for the arm."""

from dataclasses import asdict

import pytest
import torch

from paper_robot import ARM_JOINTS, JOINTS
from pixel2catch.agents import commands_of
from pixel2catch.mdp.control_step import ActionMap, JointCommand, relative_command
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NUM_ARM = len(ARM_JOINTS)
HOME = torch.tensor([[joint.home for joint in JOINTS]])
LOWER = torch.tensor([joint.lower for joint in JOINTS])
UPPER = torch.tensor([joint.upper for joint in JOINTS])


def test_affine_map_by_hand():
    """1 * 2 + 0.5 * 0.5, then 0.1 + 0.4 * 0.5; 2.4 limits the first at action 1, and 7 counts as 1."""
    commands = (
        JointCommand(anchor=1.0, offset=0.0, scale=0.5, lower=0.0, upper=2.4),
        JointCommand(anchor=0.0, offset=0.1, scale=0.4, lower=-0.3, upper=0.5),
    )
    table = ActionMap.of(commands, torch.device("cpu"))
    pos = torch.tensor([[2.0, 9.0], [2.0, 9.0], [1.0, 9.0], [-1.0, 9.0]])
    action = torch.tensor([[0.5, 0.5], [1.0, -1.0], [7.0, 7.0], [0.0, 0.0]])
    expected = torch.tensor([[2.25, 0.3], [2.4, -0.3], [1.5, 0.5], [0.0, 0.1]])
    torch.testing.assert_close(table.joint_pos_target(action, pos), expected)


def test_the_hand_reaches_its_whole_range_and_its_middle_and_the_arm_stays_at_action_zero():
    table = ActionMap.of(commands_of(UR5E_ALLEGRO), torch.device("cpu"))
    for action, expected in ((-1.0, LOWER), (0.0, (LOWER + UPPER) / 2), (1.0, UPPER)):
        target = table.joint_pos_target(torch.full((1, len(JOINTS)), action), HOME)[0]
        torch.testing.assert_close(target[NUM_ARM:], expected[NUM_ARM:])
        assert (action == 0.0) == torch.equal(target[:NUM_ARM], HOME[0, :NUM_ARM])


@pytest.mark.parametrize("joint", ARM_JOINTS, ids=lambda joint: joint.name)
def test_action_one_moves_an_arm_joint_at_its_speed_limit(joint):
    """A servo dominated by its damping moves at k / d times its distance behind its target."""
    speed = joint.velocity_limit
    steady_lag = speed * joint.damping / joint.stiffness
    scale = pytest.approx(steady_lag + speed * CONTROL_DT)
    limits = {"lower": joint.lower, "upper": joint.upper}
    assert asdict(relative_command(joint)) == {"anchor": 1.0, "offset": 0.0, "scale": scale} | limits
