"""Reward terms by hand, the agents' sums as the paper's Eq. 3 and 4; and what is near, held, lost, ended."""

from dataclasses import replace
from math import pi

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pixel2catch.agents import RESTING_REWARDS, AgentSpec, agents_of
from pixel2catch.mdp import rewards
from pixel2catch.mdp.control_step import Transition
from pixel2catch.mdp.terminations import (
    EpisodeCfg,
    is_dropped,
    is_ended,
    is_near,
    near_palms,
    reach_of,
)
from pixel2catch.methods import METHODS
from pixel2catch.scene.objects import OBJECTS, REAL, SEEN, UNSEEN
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO
from snapshots import NUM_JOINTS, privileged, transition

ARM, HAND = agents_of(UR5E_ALLEGRO)
RESTING_ARM, RESTING_HAND = agents_of(UR5E_ALLEGRO, RESTING_REWARDS)
((ARM_PART,), (HAND_PART,)) = ARM.parts, HAND.parts
ANY = replace(HAND_PART, joints=slice(0, NUM_JOINTS))


def at(*positions: tuple[float, float, float]) -> Tensor:
    return torch.tensor(positions)


def reward(agent: AgentSpec, step: Transition) -> Tensor:
    return agent.reward_terms(step).sum(dim=-1)


def test_palm_approach_by_hand():
    """A 3-4-5 triangle before, 1 m apart now: 5 - 1."""
    before = privileged(object_pos=at((3.0, 0.0, 5.0)), palm_pos=at((0.0, 4.0, 5.0)))
    now = privileged(object_pos=at((0.0, 0.0, 1.0)), palm_pos=at((0.0, 0.0, 0.0)))
    assert rewards.palm_approach(transition(before, now), ANY).tolist() == [4.0]
    assert rewards.palm_approach(transition(now, before), ANY).tolist() == [-4.0]


def test_fingertips_approach_by_hand():
    """Distances 1, 2, 3, 4 m become 1, 1, 1, 2: 0 + 1 + 2 + 2."""
    tips = torch.zeros(1, 4, 3)
    tips[0, :, 0] = torch.tensor([1.0, 2.0, 3.0, 4.0])
    closer = torch.zeros(1, 4, 3)
    closer[0, :, 1] = torch.tensor([1.0, -1.0, 1.0, 2.0])
    origin = at((0.0, 0.0, 0.0))
    step = transition(
        privileged(object_pos=origin, fingertip_pos=tips), privileged(object_pos=origin, fingertip_pos=closer)
    )
    assert rewards.fingertips_approach(step, ANY).tolist() == [5.0]


def test_approach_is_of_the_robot_whose_palm_was_nearest():
    """The left palm comes from 2 to 0.5 m, the right one from 3 to 1 m; then both from 3, to 1 and 2 m."""
    palms = [[[2.0, 3.0], [0.5, 1.0]], [[3.0, 3.0], [1.0, 2.0]]]
    before, now = (
        privileged(
            object_pos=torch.zeros(2, 3),
            palm_pos=torch.nn.functional.pad(torch.tensor([row[i] for row in palms])[..., None], (0, 2)),
            fingertip_pos=torch.full((2, 8, 3), 4.0 - i),
        )
        for i in (0, 1)
    )
    step = transition(before, now)
    left, right = (replace(ANY, palms=slice(i, i + 1), fingertips=slice(4 * i, 4 * i + 4)) for i in (0, 1))
    assert rewards.palm_approach(step, left).tolist() == [1.5, 2.0]
    assert rewards.palm_approach(step, right).tolist() == [0.0, 1.0]
    tips = 4 * 3**0.5
    assert rewards.fingertips_approach(step, left).tolist() == pytest.approx([tips, tips])
    assert rewards.fingertips_approach(step, right).tolist() == pytest.approx([0.0, tips])


def test_success_is_paid_for_the_first_hold():
    now = privileged(object_pos=torch.ones(5, 3))
    step = transition(now=now, held_steps=(0, 19, 20, 21, 20), rested_steps=(0, 0, 1, 2, 10))
    assert rewards.success(step, ANY).tolist() == [0.0, 0.0, 1.0, 0.0, 0.0]


def test_of_a_large_object_every_palm_is_called_and_paid_its_share():
    """A ball of 15 cm, and one of 13: only the first needs the right palm, which comes from 2 to 1.5 m.

    The left palm looks up, the right one at the object: a ball lies a radius of 7.5 cm over it.
    """
    reach = torch.tensor([0.11, 0.1])
    before, now = (
        privileged(
            object_pos=torch.zeros(2, 3),
            object_reach=reach,
            palm_pos=torch.tensor([[[left, 0.0, 0.0], [right, 0.0, 0.0]]] * 2),
            palm_normal=torch.tensor([[[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]] * 2),
            fingertip_pos=torch.zeros(2, 8, 3),
        )
        for left, right in ((0.18, 2.0), (0.1, 1.5))
    )
    step = transition(before, now, held_steps=(20, 20))
    palms = [replace(ANY, palms=slice(i, i + 1), fingertips=slice(4 * i, 4 * i + 4)) for i in (0, 1)]
    assert rewards.palm_approach(step, palms[0]).tolist() == pytest.approx([0.195 - 0.125, 0.08])
    assert rewards.palm_approach(step, palms[1]).tolist() == [0.5, 0.0]
    assert rewards.nearness(step, ANY).tolist() == [0.5, 0.0]
    assert rewards.success(step, ANY).tolist() == [0.5, 1.0]


def test_action_square_is_of_the_agents_own_joints():
    action = torch.zeros(1, NUM_JOINTS)
    action[0, :3] = torch.tensor([1.0, -2.0, 3.0])
    action[0, 10] = 5.0
    step = transition(action=action)
    assert rewards.action_square(step, ARM_PART).tolist() == [14.0]
    assert rewards.action_square(step, HAND_PART).tolist() == [25.0]


def test_grasp_takes_two_touching_parts():
    two, one, none = [True, False, True, False, False], [False, True, False, False, False], [False] * 5
    now = privileged(is_touching=torch.tensor([two, one, none]))
    assert rewards.grasp(transition(now=now), ANY).tolist() == [1.0, 0.0, 0.0]


def test_unrest_by_hand():
    """Speeds 1, -2 and 0.5 rad/s of three joints: 1 + 4 + 0.25, once the object was held for six steps."""
    speed = torch.zeros(4, NUM_JOINTS)
    speed[:, :3] = torch.tensor([1.0, -2.0, 0.5])
    speed[:, 10] = 3.0
    step = transition(now=privileged(joint_vel=speed), held_steps=(0, 5, 6, 25))
    assert rewards.unrest(step, ARM_PART).tolist() == [0.0, 0.0, 5.25, 5.25]
    assert rewards.unrest(step, HAND_PART).tolist() == [0.0, 0.0, 9.0, 9.0]


def test_torques_near_their_limits_by_hand():
    """Fingers at 100, 70 and 50 %: 0.4 + 0.1 above 60 %, in a hold; the arm at 95 %: 0.05 above 90 %."""
    share = torch.zeros(2, NUM_JOINTS)
    share[:, :2], share[:, 6:9] = torch.tensor([0.95, 0.8]), torch.tensor([1.0, 0.7, 0.5])
    step = transition(now=privileged(torque_share=share), held_steps=(0, 1))
    assert rewards.holding_torque(step, HAND_PART).tolist() == pytest.approx([0.0, 0.5])
    assert rewards.limit_torque(step, ARM_PART).tolist() == pytest.approx([0.05, 0.05])


def test_table_intrusion_by_hand():
    """The upper arm is 0.425 m long, its shoulder 0.9835 m high, its capsule 55 mm thick, the table 0.81 m.

    Lowered by 0.3 rad its end is 0.8579 m high: 27.1 mm in the space of 20 mm over the table, if it points to
    where that is. The other way it is beside it, 0.406 m before a base that is 5 cm nearer to that edge.
    """
    target = torch.zeros(3, NUM_JOINTS)
    target[:, 0] = torch.tensor([0.0, 0.0, pi])
    target[:, 1] = torch.tensor([0.0, 0.3, 0.3])
    step = transition(now=privileged(object_pos=torch.zeros(3, 3)), joint_pos_target=target)
    assert rewards.table_intrusion(step, ANY).tolist() == pytest.approx([0.0, 0.0271, 0.0], abs=1e-4)


def eventful_step() -> Transition:
    """A hold completes while the object is low; the palm gains 0.5 m, each fingertip 1 m."""
    origin, low = at((0.0, 0.0, 0.0)), at((1.0, 0.0, 0.4))
    tips = low[:, None].expand(1, 4, 3)
    before = privileged(
        object_pos=low, palm_pos=low + at((0.55, 0.0, 0.0)), fingertip_pos=tips + at((0.0, 0.0, 1.0))[:, None]
    )
    now = privileged(
        object_pos=low + origin,
        palm_pos=low + at((0.05, 0.0, 0.0)),
        fingertip_pos=tips.clone(),
        is_robot_on_table=torch.tensor([True]),
    )
    action = torch.cat((torch.full((1, 6), 0.5), torch.full((1, 13), -1.0)), dim=-1)
    return transition(before, now, action=action, held_steps=(20,))


def test_arm_reward_is_equation_3():
    """r_time + r_palm + 10 succ + 0.1 app - 5 (drop + coll) - 0.01 |a|^2."""
    expected = -0.01 + 0.5 + 10 * 1 + 0.1 * 1 - 5 * (1 + 1) - 0.01 * 6 * 0.25
    assert reward(ARM, eventful_step()).item() == pytest.approx(expected, abs=1e-6)


def test_hand_reward_is_equation_4():
    """(r_palm + r_fingertips) / 5 + 10 succ - 5 (drop + coll) - 0.01 |a|^2."""
    expected = (0.5 + 4 * 1.0) / 5 + 10 * 1 - 5 * (1 + 1) - 0.01 * 13
    assert reward(HAND, eventful_step()).item() == pytest.approx(expected, abs=1e-6)


@given(st.integers(0, 2**31), st.integers(0, 25))
def test_the_single_and_the_sharing_agents_get_the_sum_of_both(seed, held_steps):
    generator = torch.Generator().manual_seed(seed)
    snapshots = [
        privileged(
            object_pos=torch.randn(3, 3, generator=generator),
            fingertip_pos=torch.randn(3, 4, 3, generator=generator),
            is_robot_on_table=torch.rand(3, generator=generator) < 0.5,
            is_self_contact=torch.rand(3, generator=generator) < 0.5,
            joint_vel=torch.randn(3, NUM_JOINTS, generator=generator),
        )
        for _ in range(2)
    ]
    action = torch.randn(3, NUM_JOINTS, generator=generator)
    step = transition(*snapshots, action=action, held_steps=(held_steps,) * 3)
    total = reward(ARM, step) + reward(HAND, step)
    for agent in (ARM + HAND, *METHODS["shared_reward"].agents):
        torch.testing.assert_close(reward(agent, step), total)
    total = reward(RESTING_ARM, step) + reward(RESTING_HAND, step)
    for agent in (*METHODS["catch"].agents, *METHODS["catch_alone"].agents):
        torch.testing.assert_close(reward(agent, step), total)


def test_resting_agents_pay_for_moving_what_they_hold_and_for_touching_themselves():
    """The arm 0.01 times its squared speeds, 6 x 0.5², the hand 0.02 in contact, however its fingers move."""
    speed = torch.cat((torch.full((1, 6), 0.5), torch.full((1, 13), -0.2)), dim=-1)
    now = privileged(joint_vel=speed, is_self_contact=torch.tensor([True]))
    held, free = transition(now=now, held_steps=(6,)), transition(now=now, held_steps=(5,))
    for resting, plain, paid, unheld in (
        (RESTING_ARM, ARM, -0.015, 0.0),
        (RESTING_HAND, HAND, -0.02, -0.02),
        (RESTING_ARM + RESTING_HAND, ARM + HAND, -0.035, -0.02),
    ):
        for step, expected in ((held, paid), (free, unheld)):
            difference = reward(resting, step) - reward(plain, step)
            assert difference.item() == pytest.approx(expected, abs=1e-5)
    quiet = transition(now=privileged(), held_steps=(6,))
    assert torch.equal(reward(RESTING_HAND, quiet), reward(HAND, quiet))


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
