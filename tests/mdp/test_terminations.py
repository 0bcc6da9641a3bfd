"""Near, held, lost, ended."""

import pytest
import torch

from pixel2catch.mdp.control_step import Transition
from pixel2catch.mdp.terminations import (
    EpisodeCfg,
    is_dropped,
    is_ended,
    is_near,
    near_palms,
    reach_of,
)
from pixel2catch.scene.objects import OBJECTS, REAL, SEEN, UNSEEN
from snapshots import privileged, transition


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (-0.48, 0.6, -0.64)])
def test_near_is_a_ball_of_eight_centimetres(direction):
    palm, distances = torch.tensor([[0.4, 0.1, 1.4]] * 3), torch.tensor([[0.0], [0.0799], [0.0801]])
    now = privileged(object_pos=palm + distances * torch.tensor([direction]), palm_pos=palm)
    assert is_near(now).tolist() == [True, True, False]


def test_a_large_object_is_reached_at_its_surface():
    """The release's objects at 8 cm from their middle, a ball of 28 cm at 17.5; by each palm for itself."""
    assert max(OBJECTS[name].radius for name in (*SEEN, *UNSEEN, *REAL)) < 0.0405
    assert {reach_of(OBJECTS[name].radius) for name in (*SEEN, *UNSEEN, *REAL)} == {0.08}
    assert reach_of(0.14) == pytest.approx(0.175)
    assert OBJECTS["ball_28"].radius == pytest.approx(0.14, rel=0.01)
    palms = torch.tensor([[[1.0, 0.17, 1.0], [1.0, -0.18, 1.0]]])
    for reach, expected in ((0.175, [True, False]), (0.185, [True, True]), (0.08, [False, False])):
        now = privileged(palm_pos=palms, object_reach=torch.tensor([reach]))
        assert near_palms(now).tolist() == [expected]
        assert is_near(now).item() == any(expected)


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((0.5, 0.0, 0.451), False),
        ((0.5, 0.0, 0.449), True),
        ((0.031, 0.0, 1.0), False),
        ((0.029, 0.0, 1.0), True),
        ((-3.0, 0.0, 0.0), True),
    ],
)
def test_dropped(position, expected):
    assert is_dropped(privileged(object_pos=torch.tensor([position]))).item() is expected


def steps() -> Transition:
    """Nothing, time-out, drop, success."""
    pos = torch.tensor([[1.0, 0.0, 1.0]] * 4)
    pos[2, 2] = 0.1
    return transition(now=privileged(object_pos=pos), held_steps=(0, 0, 0, 20), episode_steps=(89, 90, 3, 50))


def test_an_episode_ends_on_time_out_drop_and_success():
    assert is_ended(steps(), EpisodeCfg()).tolist() == [False, True, True, True]


@pytest.mark.parametrize("ends", [True, False])
def test_robot_contact_ends_an_episode_if_configured(ends: bool):
    now = privileged(is_robot_contact=torch.tensor([False, True]))
    step = transition(now=now, held_steps=(0, 0), episode_steps=(3, 3))
    assert is_ended(step, EpisodeCfg(ends_on_robot_contact=ends)).tolist() == [False, ends]


def test_an_episode_ends_rest_steps_after_a_success_also_if_the_hold_was_interrupted():
    assert is_ended(steps(), EpisodeCfg(rest_steps=30)).tolist() == [False, True, True, False]
    now = privileged(object_pos=torch.ones(3, 3))
    held = transition(now=now, held_steps=(49, 50, 1), rested_steps=(30, 31, 31))
    assert is_ended(held, EpisodeCfg(rest_steps=30)).tolist() == [False, True, True]
