"""The protocol with throws and policies whose outcome is known."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from actors import Scripted, grasp

from pixel2catch.agents import commands_of
from pixel2catch.envs.catch_env import CatchEnvCfg, Step
from pixel2catch.errors import InvalidValueError
from pixel2catch.evaluation.protocol import (
    CLOSED_LOOP_EVERY,
    HOLD_TEST_STEPS,
    TEST_STEPS,
    TRIAL_STEPS,
    EvaluationCfg,
    RoundState,
    Trials,
    evaluate,
    run_round,
    shake_action,
)
from pixel2catch.mdp.randomization import RandomizationCfg
from pixel2catch.mdp.sensing import SensingCfg
from pixel2catch.mdp.tensors import mapped
from pixel2catch.mdp.throws import ThrowCfg
from pixel2catch.methods import PROPOSED
from pixel2catch.workcells.ur5e_allegro import UR5E_ALLEGRO
from snapshots import tensors

PALM = (0.434, 0.133, 1.391)
"""Palm in the start pose [m]."""

NUM_ENVS = 8
ARM_COMMANDS = commands_of(UR5E_ALLEGRO)[:6]
ROUND_STEPS = TRIAL_STEPS + TEST_STEPS
NEVER = 6 * ROUND_STEPS


def over_the_palm(hover_steps: int, height: float = 0.05) -> EvaluationCfg:
    """A ball that hovers over the palm of a robot in its start pose [m], and then drops."""
    x, y, z = PALM[0] + 0.02, PALM[1], PALM[2] + height
    throws = ThrowCfg(
        release_x=(x, x),
        release_y=(y, y),
        release_z=(z, z),
        aim_x=(x - 1e-3, x + 1e-3),
        aim_y=(y - 1e-3, y + 1e-3),
        aim_z=(z - 0.01, z - 0.01),
        peak_z=(z + 0.01, z + 0.01),
        clearance=0.01,
        hover_steps=(hover_steps, hover_steps),
    )
    task = CatchEnvCfg(throws=throws, randomization=RandomizationCfg(initial_joint_noise=0.0))
    return EvaluationCfg(objects=("sphere_s",), num_envs=NUM_ENVS, trials=1, task=task)


TWO_ROUNDS = replace(over_the_palm(hover_steps=5), trials=2)


@pytest.fixture(scope="module")
def both() -> Trials:
    """A hand closes in the first of two rounds, after a ball has fallen into it, and stays closed."""
    return evaluate(grasp(closes_at=9), PROPOSED, TWO_ROUNDS)


@pytest.fixture(scope="module")
def held(both: Trials) -> Trials:
    return mapped(lambda values: values[:NUM_ENVS], both)


def test_a_closed_hand_holds_what_fell_into_it(held: Trials):
    assert held.record.is_tracked.all()
    assert held.record.is_success.all()
    assert held.is_verified.float().mean() >= 0.75
    assert held.record.steps[held.is_verified].max() < ROUND_STEPS
    assert (held.hold_steps[held.is_verified] == TEST_STEPS).all()
    assert held.record.max_object_force.min() > 0.03 * 9.81  # more than its weight


def test_the_policy_goes_on_in_the_closed_loop_hold_of_every_third_throw(held: Trials):
    """A hand that stays closed keeps the ball; one that opens at step 60 loses it, but not when frozen."""
    opening = Scripted(lambda step: (0.0, 1.0 if 9 <= step < 60 else -1.0))
    opens = evaluate(opening, PROPOSED, over_the_palm(hover_steps=5))
    for trials, least, most in ((held, 0.75, 1.0), (opens, 0.0, 0.25)):
        assert trials.is_verified.float().mean() >= 0.75
        is_tested = torch.arange(NUM_ENVS) % CLOSED_LOOP_EVERY == 0
        assert (trials.closed_loop[~is_tested] == -1).all()
        assert least <= trials.closed_loop[is_tested].float().mean() <= most


def test_a_closed_loop_hold_changes_no_other_round(both: Trials):
    env, actor = TWO_ROUNDS.make_env(PROPOSED), grasp(closes_at=9)
    alone = [run_round(env, actor) for _ in range(2)]
    env.close()
    expected = replace(Trials.concatenate(alone), closed_loop=both.closed_loop)
    assert all(map(torch.equal, tensors(both), tensors(expected)))


@pytest.fixture
def is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials last as in the nominal task, however long the ball hovers."""
    monkeypatch.setattr(CatchEnvCfg, "trial_steps", TRIAL_STEPS)


@pytest.mark.usefixtures("is_short")
def test_an_object_that_hovers_at_the_palm_is_no_verified_hold():
    trials = evaluate(grasp(closes_at=NEVER), PROPOSED, over_the_palm(hover_steps=ROUND_STEPS))
    assert trials.record.is_success.float().mean() >= 0.5
    assert not trials.is_verified.any()


def test_a_trial_is_as_much_longer_as_the_object_hovers_longer():
    held_at = TRIAL_STEPS - 10
    trials = evaluate(grasp(closes_at=held_at + 6), PROPOSED, over_the_palm(held_at, height=0.15))
    assert trials.record.is_success.float().mean() >= 0.5
    assert (trials.record.steps > TRIAL_STEPS).any()


@pytest.mark.usefixtures("is_short")
def test_success_after_the_end_of_the_trial_does_not_count():
    """A ball out of reach that arrives at the palm within the last 20 steps is tracked, but held too late."""
    trials = evaluate(grasp(closes_at=NEVER), PROPOSED, over_the_palm(TRIAL_STEPS - 10, height=0.15))
    assert trials.record.is_tracked.float().mean() >= 0.5
    assert not trials.record.is_success.any()
    assert (trials.record.steps <= TRIAL_STEPS).all()


def test_an_action_that_is_nan_is_reported_at_the_end_of_a_round():
    """On a GPU a step does not wait for the device: what it found is reported when the round has ended."""
    cfg = EvaluationCfg(objects=("cube_s",), num_envs=1, trials=1)
    env = cfg.make_env(PROPOSED)

    def spoil(_: Step, state: RoundState) -> None:
        env._is_nan[0] = not state.is_running.any()

    with pytest.raises(InvalidValueError, match="an action of agent 'arm' is NaN"):
        run_round(env, grasp(0), spoil)
    env.close()


@pytest.mark.usefixtures("is_short")
def test_actions_are_latched_after_a_success():
    """The arm holds its position and the hand repeats its last action; the policy would move both."""
    states: list[RoundState] = []

    env = over_the_palm(hover_steps=ROUND_STEPS).make_env(PROPOSED)
    flicker = Scripted(lambda step: (0.1 * (-1.0) ** step, (-1.0) ** step))
    run_round(env, flicker, lambda step, state: states.append(state))
    env.close()
    assert (states[-1].test_steps == TEST_STEPS).any()
    for before, after in pairwise(states):
        tested = before.is_testing
        assert torch.equal(after.action[tested, 6:], before.action[tested, 6:])
        resting = tested & (after.test_steps <= HOLD_TEST_STEPS)
        assert (after.action[resting, :6] == 0.0).all()
        assert (after.action[~tested, :6].abs() == 0.1).all()


def test_shake_accelerates_the_palm():
    """Peak acceleration of the palm about 5 m/s², by second differences of control steps, without noise."""
    randomization = RandomizationCfg(action_noise=0.0, action_bias=0.0)
    quiet = CatchEnvCfg(randomization=randomization, sensing=SensingCfg(joint_noise=0.0))
    cfg = EvaluationCfg(objects=("sphere_s",), num_envs=NUM_ENVS, task=quiet)
    env = cfg.make_env(PROPOSED)
    palms = []
    site = env.world.simulation.bind("site_xpos")
    palm = env.world.simulation.model.site("palm").id
    for step in range(HOLD_TEST_STEPS - 5, TEST_STEPS):
        env.step(
            {
                "arm": shake_action(torch.full((NUM_ENVS,), step), ARM_COMMANDS),
                "hand": torch.zeros(NUM_ENVS, 13),
            }
        )
        palms.append(site[:, palm].clone())
    env.close()
    pos = torch.stack(palms)
    acceleration = (pos[2:] - 2 * pos[1:-1] + pos[:-2]) * 30.0**2
    peaks = acceleration.norm(dim=-1).amax(dim=0)
    assert peaks.min() > 3.0
    assert peaks.max() < 7.0
