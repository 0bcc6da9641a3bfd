"""Latency and command filter: the laws of a path, step by step, in float64."""

import numpy as np
import pytest
import torch

from pixel2catch.envs.actuators import CommandPath
from pixel2catch.robots.joint_dynamics import JointDynamics, command_lag, filter_step, filter_transition

DT = 1.0 / 240.0
NUM_STEPS, HOLD = 40, 8
TIMES = DT * np.arange(NUM_STEPS + 1)
DIRECT = JointDynamics.nominal(("elbow_joint", "index_joint_1"))
FILTERED = DIRECT.with_values(filter_gain=[300.0, 200.0], filter_lookahead=[0.1, 0.08])


def ramps() -> np.ndarray:
    """Commands (num_steps + 1, 2) at the edges of steps: first at rest, then a new ramp every eight steps."""
    knots = np.random.default_rng(5).uniform(-1.0, 1.0, (NUM_STEPS // HOLD, 2))
    knots = np.concatenate((np.zeros((1, 2)), knots))
    return np.stack([np.interp(TIMES, TIMES[::HOLD], knots[:, j]) for j in range(2)], axis=-1)


def make(dynamics: JointDynamics, num_envs: int = 1) -> CommandPath:
    path = CommandPath(dynamics, DT, torch.zeros(num_envs, 2, dtype=torch.float64))
    path.reset(torch.ones(num_envs, dtype=torch.bool), torch.zeros(num_envs, 2, dtype=torch.float64))
    return path


def passed(dynamics: JointDynamics, commands: np.ndarray) -> np.ndarray:
    """What arrives in every step of commands at the edges of steps, (num_steps, 2)."""
    path = make(dynamics)
    return np.stack([path.advance(torch.tensor(row)[None])[0].numpy().copy() for row in commands[1:]])


@pytest.mark.parametrize("latency", [(0.0, 0.3 * DT), (0.0123, 0.05), (DT, 3 * DT)])
def test_what_arrives_is_the_mean_of_the_delayed_ramp_over_the_step(latency):
    """At any latency: against a fine sum over every step."""
    dynamics = DIRECT.with_values(latency=np.array(latency))
    arrived, commands, lag = passed(dynamics, ramps()), ramps(), command_lag(dynamics, DT)
    fine = (np.arange(2000) + 0.5) / 2000 * DT
    for j in range(2):
        sent = TIMES[:-1, None] + fine - lag[j]
        mean = np.interp(sent, TIMES, commands[:, j]).mean(axis=1)
        np.testing.assert_allclose(arrived[:, j], mean, atol=1e-6)


def test_a_command_by_hand():
    """It rises from 0 to 1 in the third step: its mean over the step about that one's beginning is 1/8."""
    rise = np.repeat(np.array((0.0, 0.0, 0.0, 1.0, 1.0, 1.0))[:, None], 2, axis=1)
    np.testing.assert_allclose(passed(DIRECT, rise)[:, 0], (0.0, 0.0, 0.125, 0.875, 1.0))


def test_step_response_of_the_filter_is_the_analytic_one():
    """A damped oscillator, ω² = gain and 2ζω = gain · lookahead, from rest to 1."""
    transition = torch.tensor(filter_transition(FILTERED, DT))
    state, goal, path = torch.zeros(1, 2, 2, dtype=torch.float64), torch.ones(1, 2, dtype=torch.float64), []
    for _ in range(NUM_STEPS):
        filter_step(transition, state, goal)
        path.append(state[0].numpy().copy())
    decay = FILTERED.filter_gain * FILTERED.filter_lookahead / 2
    omega = np.sqrt(FILTERED.filter_gain - decay**2)
    time = TIMES[1:, None]
    wave = np.exp(-decay * time) * (np.cos(omega * time) + decay / omega * np.sin(omega * time))
    speed = np.exp(-decay * time) * FILTERED.filter_gain / omega * np.sin(omega * time)
    np.testing.assert_allclose(np.stack(path)[..., 0], 1.0 - wave, atol=1e-12)
    np.testing.assert_allclose(np.stack(path)[..., 1], speed, atol=1e-12)


@pytest.mark.parametrize("dynamics", [DIRECT, FILTERED], ids=["direct", "filtered"])
def test_reset_changes_masked_environments_only(dynamics):
    path, untouched = make(dynamics, 2), make(dynamics, 2)
    mask, place = torch.tensor((True, False)), torch.full((2, 2), 0.4, dtype=torch.float64)
    commands = torch.tensor(ramps()[1:14])
    for command in commands[:-1]:
        path.advance(command.expand(2, 2))
        untouched.advance(command.expand(2, 2))
    path.reset(mask, place)
    command = torch.where(mask[:, None], place, commands[-1])
    arrived, expected = path.advance(command), untouched.advance(command)
    torch.testing.assert_close(arrived[0], place[0])
    assert torch.equal(arrived[1], expected[1])
    assert (arrived[0] - arrived[1]).abs().min() > 0.01
