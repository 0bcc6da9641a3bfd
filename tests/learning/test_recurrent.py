"""Recurrent networks: their sequences, their episodes, what only they can learn, and their policies."""

import dataclasses
from pathlib import Path

import pytest
import torch
from reaching import CONTRACT, SMALL, ReachingEnv, TaughtEnv, roll_out
from torch import Tensor, nn

from pixel2catch.errors import InvalidValueError
from pixel2catch.learning.mappo import Mappo
from pixel2catch.learning.networks import gru_rollout
from pixel2catch.policy import Policy

RECURRENT = dataclasses.replace(SMALL, recurrent=16)


def sequence(num_steps: int) -> tuple[nn.GRUCell, Tensor, Tensor]:
    """A GRU, inputs of three environments and its hidden state before."""
    torch.manual_seed(0)
    return nn.GRUCell(4, 5), torch.randn(num_steps, 3, 4), torch.randn(1, 3, 5)


def test_a_sequence_cut_at_an_episodes_end_is_two_sequences() -> None:
    gru, inputs, state = sequence(7)
    is_first = torch.zeros(7, 3, dtype=torch.bool)
    is_first[4] = True
    whole = gru_rollout(gru, inputs, state, is_first)
    before = gru_rollout(gru, inputs[:4], state, is_first[:4])
    after = gru_rollout(gru, inputs[4:], torch.zeros(1, 3, 5), torch.zeros(3, 3, dtype=torch.bool))
    torch.testing.assert_close(whole, torch.cat((before, after)))
    assert (gru_rollout(gru, inputs, state, ~is_first)[4] - whole[4]).abs().max() > 1e-3


def test_gradients_of_a_sequence_are_those_of_a_loop_by_hand() -> None:
    gru, inputs, state = sequence(6)
    is_first = torch.rand(6, 3) < 0.3
    weights = torch.randn(6, 3, 5)
    found = torch.autograd.grad(
        (weights * gru_rollout(gru, inputs, state, is_first)).sum(), [*gru.parameters()]
    )
    now, total = state[0], torch.zeros(())
    for t in range(6):
        now = torch.where(is_first[t][:, None], torch.zeros_like(now), now)
        now = gru(inputs[t], now)
        total = total + (weights[t] * now).sum()
    for gradient, expected in zip(found, torch.autograd.grad(total, [*gru.parameters()]), strict=True):
        torch.testing.assert_close(gradient, expected)


def test_learning_sees_what_acting_saw() -> None:
    """The probabilities of a whole rollout are those of its actions, over episodes and over updates."""
    torch.manual_seed(0)
    mappo, env = Mappo(RECURRENT, ReachingEnv(RECURRENT), CONTRACT), ReachingEnv(RECURRENT)
    observation = env.reset()
    mappo.reset_hidden()
    for number in range(3):
        for _ in range(RECURRENT.rollout_steps):
            step = env.step(mappo.act(observation))
            mappo.record(step)
            observation = step.observation
        networks, rollout = mappo.networks["arm"], mappo.rollout["arm"]
        is_first = torch.cat((torch.zeros_like(mappo.is_done[:1]), mappo.is_done[:-1]))
        assert is_first.any()
        assert bool(rollout.policy_hidden_state.any()) == bool(number)
        inputs = networks.observation_scale(rollout.observations)
        features = gru_rollout(networks.policy_gru, inputs, rollout.policy_hidden_state, is_first)
        log_prob = networks.log_prob(networks.policy(features), rollout.actions)
        torch.testing.assert_close(log_prob, rollout.log_prob)
        mappo.update(0.0)


def test_the_exported_policy_acts_like_the_learner_and_is_adopted() -> None:
    mappo = Mappo(RECURRENT, ReachingEnv(RECURRENT), CONTRACT)
    roll_out(mappo, ReachingEnv(RECURRENT))
    mappo.update(0.0)
    roll_out(mappo, ReachingEnv(RECURRENT))
    policy, networks, rollout = mappo.export(), mappo.networks["arm"], mappo.rollout["arm"]
    inputs = networks.observation_scale(rollout.observations)
    is_first = torch.cat((torch.zeros_like(mappo.is_done[:1]), mappo.is_done[:-1]))
    features = gru_rollout(networks.policy_gru, inputs, torch.zeros(1, SMALL.num_envs, 16), is_first)
    for t, expected in enumerate(networks.policy(features)):
        policy.reset(is_first[t])
        observations = {agent: batch.observations[t] for agent, batch in mappo.rollout.items()}
        torch.testing.assert_close(policy.act(observations)["arm"], expected.clamp(-1.0, 1.0))
    other = Mappo(RECURRENT, ReachingEnv(RECURRENT), CONTRACT)
    other.adopt(policy)
    for name, tensor in other.export().state_dict().items():
        torch.testing.assert_close(tensor, policy.state_dict()[name])
    with pytest.raises(InvalidValueError, match="--recurrent 16"):
        Mappo(SMALL, ReachingEnv(SMALL), CONTRACT).adopt(policy)


def test_a_teacher_may_be_recurrent(tmp_path: Path) -> None:
    """The teacher actions are those of its policy, acted by itself."""
    Policy(CONTRACT, SMALL.hidden, recurrent=8).save(tmp_path)
    cfg = dataclasses.replace(SMALL, teacher=tmp_path)
    mappo = Mappo(cfg, TaughtEnv(cfg), CONTRACT)
    roll_out(mappo, TaughtEnv(cfg))
    teacher = Policy.load(tmp_path)
    for t in range(cfg.rollout_steps):
        actions = teacher.act({agent: batch.observations[t] for agent, batch in mappo.rollout.items()})
        for agent, action in actions.items():
            torch.testing.assert_close(mappo.rollout[agent].teacher_actions[t], action)
        teacher.reset(mappo.is_done[t])
