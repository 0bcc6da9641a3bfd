"""Statistics of episodes: a case worked out by hand, and keys that never change."""

import math
from dataclasses import replace

import pytest
import torch

from pixel2catch.envs.catch_env import CatchEnv, CatchEnvCfg
from pixel2catch.envs.episodes import FAILURES, EpisodeRecord, failure
from pixel2catch.envs.physics_log import PhysicsLog
from pixel2catch.envs.statistics import EpisodeStatistics
from pixel2catch.mdp.snapshot import Privileged, Transition
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.methods import METHODS

OBJECTS = ("ball", "box")
TERMS = {"arm": ("arm.a", "arm.b"), "hand": ("hand.c",)}
VALUES = {
    "arm": torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
    "hand": torch.tensor([[0.0], [0.0], [3.0]]),
}


def statistics() -> EpisodeStatistics:
    return EpisodeStatistics(OBJECTS, ((0.0, 1.0), (0.0, 1.0)), TERMS, torch.device("cpu"))


def yes(*rows: int) -> torch.Tensor:
    return torch.tensor([float(row) for row in rows]) > 0


def record() -> EpisodeRecord:
    """A ball caught near the first corner, a box that bounced off near the last, a box never reached."""
    aim = torch.tensor([[0.1, 0.1, 1.0], [0.9, 0.9, 1.0], [0.1, 0.4, 1.0]])
    start = EpisodeRecord.start(torch.tensor([0, 1, 1]), aim)
    return replace(
        start,
        steps=torch.tensor([40, 60, 80]),
        is_tracked=yes(1, 1, 0),
        is_success=yes(1, 0, 0),
        is_palm_contact=yes(1, 0, 0),
        is_hand_contact=yes(1, 1, 0),
        is_dropped=yes(0, 1, 1),
        is_self_contact=yes(0, 0, 1),
        contact_height=torch.tensor([1.0, 1.2, 0.0]),
        contact_steps=torch.tensor([20, 2, 0]),
        penetration_sum=torch.tensor([0.02, 0.002, 0.0]),
        max_joint_speed=torch.tensor([2.0, 2.5, 1.0]),
    )


def test_a_case_by_hand():
    sums = statistics()
    sums.add(yes(1, 1, 1), record(), VALUES)
    sums.add(yes(0, 0, 0), record(), VALUES)
    result = sums.pop()
    expected = {
        "episodes": 3.0,
        "tracking_rate": 2 / 3,
        "success_rate": 1 / 3,
        "palm_contact_rate": 1 / 3,
        "table_contact_rate": 0.0,
        "self_contact_rate": 1 / 3,
        "contact_height": 1.1,
        "mean_penetration": 0.001,
        "episode_steps": 60.0,
        "failure/never_reached": 1 / 3,
        "failure/bounced_off": 1 / 3,
        "failure/dropped": 0.0,
        "failure/not_held": 0.0,
        "max_joint_speed": 2.5,
        "success_rate/ball": 1.0,
        "success_rate/box": 0.0,
        "success_rate/landing_0": 1.0,
        "success_rate/landing_1": 0.0,
        "success_rate/landing_7": 0.0,
        "reward_term/arm.a": 3.0,
        "reward_term/arm.b": 4.0,
        "reward_term/hand.c": 1.0,
    }
    assert {name: result[name] for name in expected} == pytest.approx(expected)
    assert math.isnan(result["success_rate/landing_2"])


def test_only_episodes_that_ended_count():
    sums = statistics()
    sums.add(yes(0, 1, 0), record(), VALUES)
    result = sums.pop()
    assert (result["episodes"], result["tracking_rate"], result["success_rate"]) == (1.0, 1.0, 0.0)
    assert result["failure/bounced_off"] == 1.0
    assert math.isnan(result["success_rate/ball"])


def test_popping_starts_anew_and_keys_stay():
    sums = statistics()
    empty = sums.pop()
    assert empty["episodes"] == 0.0
    assert math.isnan(empty["success_rate"])
    sums.add(yes(1, 1, 1), record(), VALUES)
    assert list(sums.pop()) == list(empty)
    assert sums.pop()["episodes"] == 0.0


def test_statistics_of_several_processes():
    """Three processes with the same sums: counts are threefold, rates the same; the largest is another's."""
    alone, one = statistics(), statistics()
    for sums in (alone, one):
        sums.add(yes(1, 1, 1), record(), VALUES)
    expected = alone.pop() | {"episodes": 9.0, "max_joint_speed": 3.0}
    result = one.pop(lambda sums: 3.0 * sums, lambda maxima: maxima.clamp(min=3.0))
    assert result["max_torque_share"] == 3.0
    names = [name for name in expected if not name.startswith("max_") or name == "max_joint_speed"]
    assert {n: result[n] for n in names} == pytest.approx({n: expected[n] for n in names}, nan_ok=True)


@pytest.mark.parametrize(
    ("tracked", "dropped", "contact_steps", "expected"),
    [
        (0, 1, 0, "never_reached"),
        (0, 0, 0, "never_reached"),
        (1, 1, 3, "bounced_off"),
        (1, 1, 4, "dropped"),
        (1, 0, 2, "not_held"),
    ],
)
def test_why_an_episode_failed(tracked, dropped, contact_steps, expected):
    start = EpisodeRecord.start(torch.tensor([0]), torch.zeros(1, 3))
    ended = replace(
        start, is_tracked=yes(tracked), is_dropped=yes(dropped), contact_steps=torch.tensor([contact_steps])
    )
    assert FAILURES[int(failure(ended).item())] == expected


def step_of(height: float, held: int, number: int) -> Transition:
    now = Privileged(
        palm_pos=torch.tensor([[1.0, 0.0, 1.0]]),
        fingertip_pos=torch.zeros(1, 4, 3),
        object_pos=torch.tensor([[1.0, 0.0, height]]),
        object_lin_vel=torch.zeros(1, 3),
        is_touching=torch.zeros(1, 5, dtype=torch.bool),
        is_robot_on_table=yes(0),
    )
    return Transition(
        before=now,
        now=now,
        action=torch.zeros(1, 19),
        held_steps=torch.tensor([held]),
        episode_steps=torch.tensor([number]),
    )


def log_of(touching: bool, penetration: float) -> PhysicsLog:
    touched = torch.zeros(1, 5, dtype=torch.bool)
    touched[0, 2] = touching
    depth, none = torch.tensor([penetration]), torch.zeros(1)
    return PhysicsLog(touched, yes(0), yes(0), depth, none, none, none)


def test_a_record_of_three_steps_by_hand():
    """Far and untouched; touched 4 cm over the palm, 1 mm deep; touched lower, 3 mm deep."""
    episode = EpisodeRecord.start(torch.tensor([1]), torch.zeros(1, 3))
    for height, held, number, touching, depth in (
        (1.5, 0, 1, False, 0.005),
        (1.04, 1, 2, True, 0.001),
        (1.02, 2, 3, True, 0.003),
    ):
        episode = episode.advanced(step_of(height, held, number), log_of(touching, depth))
    assert (episode.steps.item(), episode.held_steps.item(), episode.contact_steps.item()) == (3, 2, 2)
    assert episode.contact_height.item() == pytest.approx(1.04)
    assert episode.penetration_sum.item() == pytest.approx(0.004)
    assert episode.max_penetration.item() == pytest.approx(0.005)
    flags = (episode.is_tracked, episode.is_hand_contact, episode.is_palm_contact, episode.is_success)
    assert [flag.item() for flag in flags] == [True, True, False, False]


@pytest.mark.parametrize("name", ["proposed", "single_agent"])
def test_reward_terms_sum_to_the_rewards(name):
    method = METHODS[name]
    env = CatchEnv(CatchEnvCfg(episode=EpisodeCfg(max_steps=5)), method, num_envs=4)
    keys, total = list(env.statistics.pop()), dict.fromkeys(env.action_sizes, 0.0)
    for _ in range(6):
        step = env.step({agent: torch.full((4, size), 0.5) for agent, size in env.action_sizes.items()})
        total = {agent: total[agent] + step.rewards[agent].mean().item() / 6 for agent in total}
    result = env.statistics.pop()
    assert list(result) == keys
    assert result["episodes"] == 4.0
    for agent in method.agents:
        prefixes = tuple(f"reward_term/{part.name}." for part in agent.parts)
        terms = [value for key, value in result.items() if key.startswith(prefixes)]
        assert sum(terms) == pytest.approx(total[agent.name], abs=1e-5)
