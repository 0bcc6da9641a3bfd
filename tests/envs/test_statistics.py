"""Statistics of episodes: a case worked out by hand, and keys that never change."""

from dataclasses import replace

import pytest
import torch
from rollouts import make, rollout

from pixel2catch.envs.episode import FAILURES, EpisodeRecord, EpisodeStatistics, StepExtremes, failure
from pixel2catch.envs.world import CatchWorld
from pixel2catch.mdp.control_step import Privileged, Transition
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.scene.scene import SceneCfg
from snapshots import GEOMETRY, privileged

OBJECTS = ("ball", "box")
TERMS = {"arm": ("arm.a", "arm.b"), "hand": ("hand.c",)}
VALUES = {
    "arm": torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
    "hand": torch.tensor([[0.0], [0.0], [3.0]]),
}


def statistics() -> EpisodeStatistics:
    return EpisodeStatistics(OBJECTS, TERMS, torch.device("cpu"))


def yes(*rows: int) -> torch.Tensor:
    return torch.tensor([float(row) for row in rows]) > 0


ARMS = (slice(0, 6),)
PALMS = (slice(0, 1),)


def record() -> EpisodeRecord:
    """A ball caught, a box that bounced off, a box never reached."""
    start = EpisodeRecord.start(torch.tensor([0, 1, 1]))
    return replace(
        start,
        steps=torch.tensor([40, 60, 80]),
        is_tracked=yes(1, 1, 0),
        rested_steps=torch.tensor([1, 0, 0]),
        is_palm_contact=yes(1, 0, 0),
        is_hand_contact=yes(1, 1, 0),
        is_dropped=yes(0, 1, 1),
        is_self_contact=yes(0, 0, 1),
        contact_steps=torch.tensor([20, 2, 0]),
        penetration_sum=torch.tensor([0.02, 0.002, 0.0]),
        max_joint_speed=torch.tensor([2.0, 2.5, 1.0]),
        hold_speed=torch.tensor([0.2, 0.1, 0.4]),
    )


def test_a_case_by_hand():
    sums = statistics()
    sums.add(yes(1, 1, 1), record(), VALUES, yes(0, 0, 0))
    sums.add(yes(0, 0, 0), record(), VALUES, yes(0, 0, 0))
    result = sums.pop()
    expected = {
        "episodes": 3.0,
        "tracking_rate": 2 / 3,
        "success_rate": 1 / 3,
        "palm_contact_rate": 1 / 3,
        "table_contact_rate": 0.0,
        "self_contact_rate": 1 / 3,
        "hold_speed": 0.2,
        "mean_penetration": 0.001,
        "episode_steps": 60.0,
        "failure/never_reached": 1 / 3,
        "failure/bounced_off": 1 / 3,
        "failure/dropped": 0.0,
        "failure/not_held": 0.0,
        "max_joint_speed": 2.5,
        "success_rate/ball": 1.0,
        "success_rate/box": 0.0,
        "reward_term/arm.a": 3.0,
        "reward_term/arm.b": 4.0,
        "reward_term/hand.c": 1.0,
    }
    assert {name: result[name] for name in expected} == pytest.approx(expected)


def test_statistics_of_several_processes():
    """Three processes with the same sums: counts are threefold, rates the same; the largest is another's."""
    alone, one = statistics(), statistics()
    for sums in (alone, one):
        sums.add(yes(1, 1, 1), record(), VALUES, yes(0, 0, 0))
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
        (0, 1, 3, "bounced_off"),  # by a corner of a large object
        (0, 1, 9, "dropped"),
        (1, 1, 3, "bounced_off"),
        (1, 1, 4, "dropped"),
        (1, 0, 2, "not_held"),
    ],
)
def test_why_an_episode_failed(tracked, dropped, contact_steps, expected):
    start = EpisodeRecord.start(torch.tensor([0]))
    ended = replace(
        start, is_tracked=yes(tracked), is_dropped=yes(dropped), contact_steps=torch.tensor([contact_steps])
    )
    assert FAILURES[int(failure(ended).item())] == expected


def state_of(height: float, joint_speed: float = 0.0) -> Privileged:
    """An object over the palm; the arm's first two joints move, and one of the hand."""
    joint_vel = torch.zeros(1, 19)
    joint_vel[0, :2] = torch.tensor([joint_speed, -joint_speed])
    joint_vel[0, 7] = 100.0
    return privileged(
        palm_pos=torch.tensor([[1.0, 0.0, 1.0]]),
        object_pos=torch.tensor([[1.0, 0.0, height]]),
        joint_vel=joint_vel,
    )


def step_of(episode: EpisodeRecord, now: Privileged) -> Transition:
    """The next control step of an episode, in which nothing moves."""
    none = torch.zeros(1, 0)
    return episode.transition(now, now, none, none, GEOMETRY)


def log_of(touching: bool, penetration: float = 0.0, itself: bool = False) -> StepExtremes:
    touched = torch.zeros(1, 5, dtype=torch.bool)
    touched[0, 2] = touching
    depth, none = torch.tensor([penetration]), torch.zeros(1)
    return StepExtremes(touched, yes(0), yes(itself), yes(0), depth, none, none, 1e4 * depth)


def test_a_record_of_three_steps_by_hand():
    """Far and untouched; touched 4 cm over the palm, 1 mm deep; lower, 3 mm deep; 10 N a millimetre."""
    episode = EpisodeRecord.start(torch.tensor([1]))
    for height, touching, depth in ((1.5, False, 0.005), (1.04, True, 0.001), (1.02, True, 0.003)):
        log = log_of(touching, depth, itself=depth != 0.001)
        episode = episode.advanced(step_of(episode, state_of(height)), log, ARMS, PALMS)
    assert (episode.steps.item(), episode.held_steps.item(), episode.contact_steps.item()) == (3, 2, 2)
    assert episode.penetration_sum.item() == pytest.approx(0.004)
    assert episode.max_penetration.item() == pytest.approx(0.005)
    assert episode.max_object_force.item() == pytest.approx(30.0)  # 50 N without a touch of the hand
    flags = (episode.is_tracked, episode.is_hand_contact, episode.is_palm_contact, episode.is_success)
    assert [flag.item() for flag in flags] == [True, True, False, False]
    assert episode.is_self_contact.item()


def held_for(episode: EpisodeRecord, num_steps: int, joint_speed: float) -> EpisodeRecord:
    """The record after some more steps of a hold, all alike."""
    for _ in range(num_steps):
        step = step_of(episode, state_of(1.04, joint_speed=joint_speed))
        episode = episode.advanced(step, log_of(True), ARMS, PALMS)
    return episode


def test_rest_is_measured_in_the_last_ten_steps_of_a_hold():
    """Two of six joints at 3 rad/s are 1 rad/s; five such steps and five of rest are 0.5 rad/s."""
    start = EpisodeRecord.start(torch.tensor([1]))
    wild = held_for(start, 10, joint_speed=30.0)
    assert wild.hold_speed.item() == 0.0
    nearly = held_for(held_for(wild, 5, joint_speed=3.0), 4, joint_speed=0.0)
    assert not nearly.is_success.item()
    for rested in (1, 2):  # the step of the success counts
        nearly = held_for(nearly, 1, joint_speed=0.0)
        assert (nearly.is_success.item(), nearly.rested_steps.item()) == (True, rested)
        assert nearly.hold_speed.item() == pytest.approx(0.5)


@pytest.mark.parametrize(("part", "is_palm"), [(1, False), (5, True)])
def test_any_palm_counts_as_palm_contact(part: int, is_palm: bool):
    """Two robots: a palm and four fingers each."""
    world = CatchWorld(SceneCfg(workcell="two_ur5e_allegro"), None, num_envs=1, device="cpu")
    assert world.palms == (slice(0, 1), slice(5, 6))
    log = log_of(False)._replace(is_touching=torch.nn.functional.one_hot(torch.tensor([part]), 10).bool())
    episode = EpisodeRecord.start(torch.tensor([1]))
    step = step_of(episode, state_of(1.04))
    assert episode.advanced(step, log, ARMS, world.palms).is_palm_contact.item() == is_palm


def test_reward_terms_sum_to_the_rewards():
    env = make(episode=EpisodeCfg(max_steps=5))
    keys, total = list(env.statistics.pop()), dict.fromkeys(env.action_sizes, 0.0)
    for step in rollout(env, 6, action=0.5):
        total = {agent: total[agent] + step.rewards[agent].mean().item() / 6 for agent in total}
    result = env.statistics.pop()
    assert list(result) == keys
    assert result["episodes"] == 4.0
    for agent in env.method.agents:
        prefixes = tuple(f"reward_term/{part.name}." for part in agent.parts)
        terms = [value for key, value in result.items() if key.startswith(prefixes)]
        assert sum(terms) == pytest.approx(total[agent.name], abs=1e-5)
