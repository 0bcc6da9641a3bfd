"""The rule that says which throws an arm can reach."""

from dataclasses import replace

import torch

from pixel2catch.envs.cfg import CatchEnvCfg
from pixel2catch.envs.episode import Episode, draw_episode
from pixel2catch.evaluation.reach import is_reachable, motion_time
from pixel2catch.mdp.throws import Throw
from pixel2catch.workcells import find_workcell

WORKCELL = find_workcell("ur5e_allegro")
NUM = 40


def drawn() -> Episode:
    cfg, objects = CatchEnvCfg().for_workcell(WORKCELL), torch.tensor([0])
    bias = torch.zeros(len(WORKCELL.joints))
    return draw_episode(cfg, bias, objects, NUM, torch.Generator().manual_seed(0))


def moved(throw: Throw, by: tuple[float, float, float]) -> Throw:
    return replace(throw, pos=throw.pos + torch.tensor(by))


def test_the_throws_of_the_paper_are_reachable():
    assert is_reachable(drawn(), WORKCELL).all()


def test_throws_beside_and_behind_the_robot_are_not():
    episode = drawn()
    for by in ((0.0, 2.0, 0.0), (3.0, 0.0, 0.0), (-1.6, 0.0, 0.0)):
        assert not is_reachable(replace(episode, throw=moved(episode.throw, by)), WORKCELL).any()


def test_a_flight_that_is_over_before_the_arm_can_move_is_not():
    """Thrown down onto the table from 0.5 m before the hand, at 8 m/s."""
    episode = drawn()
    near = replace(
        episode.throw,
        pos=torch.tensor([[1.3, 0.6, 1.0]]).expand(NUM, 3),
        lin_vel=torch.tensor([[-6.0, 0.0, -5.0]]).expand(NUM, 3),
    )
    assert not is_reachable(replace(episode, throw=near), WORKCELL).any()


def test_drag_shortens_flights():
    """By 0.5 /m no throw of the paper arrives."""
    episode = replace(drawn(), drag=torch.full((NUM,), 0.5))
    assert is_reachable(episode, WORKCELL).float().mean() < 0.3


def test_times_of_motions_by_hand():
    """1 rad by 4 rad/s² takes 0.5 s there and 0.5 s back; 3 rad 1 s more at 2 rad/s; then without a limit."""
    angle, speed = torch.tensor([1.0, 3.0, 3.0, 0.0]), torch.full((4,), 2.0)
    acceleration = torch.tensor([4.0, 4.0, torch.inf, torch.inf])
    torch.testing.assert_close(motion_time(angle, speed, acceleration), torch.tensor([1.0, 2.0, 1.5, 0.0]))
