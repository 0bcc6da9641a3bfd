"""Latencies, ages and delays, also of fractions of a control step."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from rollouts import AT_ONCE, EXACT, HOVERING, make, rollout
from torch import Tensor

from pixel2catch.envs.catch_env import CatchEnv
from pixel2catch.mdp.control_step import BoxHistory
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import ASSUMED_AGE, SensingCfg
from pixel2catch.mdp.tensors import clone
from pixel2catch.mdp.terminations import EpisodeCfg
from pixel2catch.scene.scene import SceneCfg

ANY = SensingCfg(latency_steps=(0.6, 4.3), latency_grid=0.0)
STILL = RandomizationCfg(action_noise=0.0, action_bias=0.0)
COARSE = SceneCfg(physics_hz=60.0)


def make_late(num_envs: int = 4, **changes: Any) -> CatchEnv:
    return make(num_envs, seed=7, method="proposed+boxes", scene=COARSE, **changes)


def remembered(env: CatchEnv, num_steps: int) -> Iterator[tuple[BoxHistory, Tensor]]:
    """The boxes after each step, and the latency of the episodes (num_envs, 1)."""
    for step in rollout(env, num_steps):
        yield clone(step.measurement.boxes), env.episode.parameters.latency[:, None].clone()


def test_a_box_between_two_latencies_is_the_mean_of_both():
    """Of one throw, seen half a control step earlier and half a step later; so is the tracked position."""
    paths = []
    for late in (1.0, 1.5, 2.0):
        env = make_late(2, sensing=replace(EXACT, latency_steps=(late, late)), throws=AT_ONCE)
        paths.append([clone(step.measurement) for step in rollout(env, 9)])
    for newer, between, older in zip(*paths, strict=True):
        torch.testing.assert_close(between.box, (newer.box + older.box) / 2, atol=1e-3, rtol=0)
        mean = (newer.object_pos + older.object_pos) / 2
        torch.testing.assert_close(between.object_pos, mean, atol=1e-5, rtol=0)
        assert (between.boxes.age == 1.5 + torch.arange(8)).all()
    assert (paths[0][-1].box - paths[2][-1].box).abs().max() > 3.0


def test_a_missed_image_makes_the_newest_box_older_by_one_step():
    """And adds none: boxes that are not of the beginning differ by the noise of each."""
    late = 2.5
    sensing = SensingCfg(latency_steps=(late, late), drop_rate=0.4)
    env = make_late(12, sensing=sensing, throws=HOVERING)
    path = [boxes for boxes, _ in remembered(env, 24)][int(late) :]
    is_missed = []
    for before, now in itertools.pairwise(path):
        is_new = now.age[:, 0] == late
        kept = torch.where(is_new, now.age[:, 1], now.age[:, 0])
        torch.testing.assert_close(kept, before.age[:, 0] + 1.0)
        assert torch.equal(now.box[:, 0] == before.box[:, 0], ~is_new[:, None].expand(-1, 4))
        is_missed.append(~is_new)
    missed = torch.stack(is_missed)
    assert missed.float().mean().item() == pytest.approx(0.4, abs=4 * (0.4 * 0.6 / missed.numel()) ** 0.5)
    last = path[-1]
    assert (last.age.diff(dim=1) >= 1.0).all()
    for one, other in itertools.combinations(last.box.unbind(dim=1), 2):
        assert (one != other).any(dim=-1).all()


def test_no_box_is_measured_in_a_blackout_however_late_images_are():
    """Of four control steps: the newest box grows older by four, and no more."""
    for late in (1.0, 1.5):
        sensing = replace(EXACT, latency_steps=(late, late), blackout_steps=4, least_visible=0.0)
        env = make_late(8, sensing=sensing, throws=AT_ONCE, episode=EpisodeCfg(max_steps=40))
        stale = torch.stack([boxes.age[:, 0] - late for boxes, _ in remembered(env, 27)])
        assert stale.amax(dim=0).tolist() == [4.0] * 8, late


def test_the_jitter_of_a_stamp_stays_with_its_box():
    env = make_late(8, sensing=replace(EXACT, stamp_jitter=0.004), throws=HOVERING)
    path, latencies = zip(*remembered(env, 4), strict=True)
    for before, now in itertools.pairwise(path):
        torch.testing.assert_close(now.age[:, 1:], before.age[:, :-1] + 1.0)
    error = path[-1].age[:, 0] - latencies[-1][:, 0]
    assert len(error.unique()) == 8
    assert 0.2 * 0.12 < error.std() < 5 * 0.12


def test_boxes_without_stamps_are_taken_for_as_old_as_in_training():
    """When they are delivered: after a missed image they are a control step older."""
    env = make_late(8, sensing=replace(ANY, unstamped=1.0, clock_error=0.02, drop_rate=0.3), throws=HOVERING)
    ages = torch.stack([boxes.age[:, 0] for boxes, _ in remembered(env, 12)])
    stale = ages - ASSUMED_AGE
    torch.testing.assert_close(stale, stale.round())
    assert stale.min().item() == pytest.approx(0.0, abs=1e-5)
    assert stale.max().item() > 0.5


def test_a_command_between_two_delays_moves_the_hand_between_both():
    """Of a change of the targets, half has arrived after 1.5 steps when with 1 all has, and with 2 none."""
    moved = []
    for delay in (1.0, 1.5, 2.0):
        randomization = replace(STILL, command_delay=(delay, delay), command_delay_grid=0.0)
        env = make_late(2, randomization=randomization, sensing=EXACT, throws=HOVERING)
        list(rollout(env, 18))  # then the hand is where action 0 wants it
        list(rollout(env, 1, action=0.1))
        before = env.world.joint_pos[:, 6:]
        list(rollout(env, 1, action=0.1))
        moved.append(env.world.joint_pos[:, 6:] - before)
    prompt, between, late = moved
    assert prompt.min() > 0.01
    torch.testing.assert_close(between, prompt / 2, rtol=0.1, atol=0)
    assert late.abs().max() < 2e-3


def test_perception_that_looks_at_one_image_in_several():
    """Newest ages go from the latency up by one, and begin again with each image that is looked at."""
    sensing = replace(EXACT, latency_steps=(1, 1), image_period=1.5)
    ages = [
        boxes.age[0, 0].item() for boxes, _ in remembered(make_late(1, sensing=sensing, throws=HOVERING), 31)
    ]
    assert sum(age == 1.0 for age in ages[1:]) == 20
    assert max(ages) == 2.0
    assert all(after in (1.0, before + 1.0) for before, after in itertools.pairwise(ages))
