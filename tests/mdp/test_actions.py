"""Actions to joint targets: one affine map, anchored at the measured position for the arm."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from paper_robot import ARM_JOINTS, JOINTS
from pixel2catch.agents import commands_of
from pixel2catch.mdp.control_step import ActionMap, JointCommand, relative_command
from pixel2catch.scene.constants import CONTROL_DT
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO

NUM_ARM = len(ARM_JOINTS)
COMMANDS = commands_of(UR5E_ALLEGRO)
MAP = ActionMap.of(COMMANDS, torch.device("cpu"))
HOME = torch.tensor([[joint.home for joint in JOINTS]])
LOWER = torch.tensor([joint.lower for joint in JOINTS])
UPPER = torch.tensor([joint.upper for joint in JOINTS])
SCALE = torch.tensor([command.scale for command in COMMANDS])


def rows(low: float, high: float) -> st.SearchStrategy[Tensor]:
    """One number per joint, uniform in a range."""

    def draw(seed: int) -> Tensor:
        share = torch.rand(1, len(JOINTS), generator=torch.Generator().manual_seed(seed))
        return low + (high - low) * share

    return st.integers(0, 2**31).map(draw)


def full(value: float) -> Tensor:
    return torch.full((1, len(JOINTS)), value)


def test_affine_map_by_hand():
    """1 * 2 + 0.5 * 0.5, then 0.1 + 0.4 * 0.5; and the limit 2.1 cuts the first at action 1."""
    commands = (
        JointCommand(anchor=1.0, offset=0.0, scale=0.5, lower=0.0, upper=2.4),
        JointCommand(anchor=0.0, offset=0.1, scale=0.4, lower=-0.3, upper=0.5),
    )
    table = ActionMap.of(commands, torch.device("cpu"))
    pos = torch.tensor([[2.0, 9.0]] * 3)
    action = torch.tensor([[0.5, 0.5], [1.0, -1.0], [7.0, 7.0]])
    expected = torch.tensor([[2.25, 0.3], [2.4, -0.3], [2.4, 0.5]])
    torch.testing.assert_close(table.joint_pos_target(action, pos), expected)


@given(rows(-3.0, 3.0), rows(-7.0, 7.0))
def test_targets_are_always_within_the_limits(action, pos):
    target = MAP.joint_pos_target(action, pos)[0]
    assert (target >= LOWER).all()
    assert (target <= UPPER).all()


@given(rows(-1.0, 1.0), rows(-0.01, 0.01))
def test_arm_targets_are_ahead_of_the_measured_position(action, offset):
    """Wherever the arm is measured, the target is ahead of that by scale times action, up to the limits."""
    pos = HOME + offset
    expected = torch.clamp(pos + SCALE * action, LOWER, UPPER)[:, :NUM_ARM]
    torch.testing.assert_close(MAP.joint_pos_target(action, pos)[:, :NUM_ARM], expected)


def test_the_hand_reaches_its_whole_range_and_its_middle():
    for action, expected in ((-1.0, LOWER), (0.0, (LOWER + UPPER) / 2), (1.0, UPPER)):
        target = MAP.joint_pos_target(full(action), HOME)
        torch.testing.assert_close(target[0, NUM_ARM:], expected[NUM_ARM:])


@pytest.mark.parametrize("joint", ARM_JOINTS, ids=lambda joint: joint.name)
def test_action_one_moves_an_arm_joint_at_its_speed_limit(joint):
    """A servo dominated by its damping moves at k / d times its distance behind its target."""
    speed = joint.velocity_limit
    steady_lag = speed * joint.damping / joint.stiffness
    assert relative_command(joint).scale == pytest.approx(steady_lag + speed * CONTROL_DT)
    assert relative_command(joint).anchor == 1.0
