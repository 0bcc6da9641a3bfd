"""Actions to joint targets: one affine map, anchored at the measured position for the arm."""

import torch

from pixel2catch.mdp.control_step import ActionMap, JointCommand


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
