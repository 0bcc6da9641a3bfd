"""Recorded commands on their way."""

import numpy as np

from pixel2catch.identification.simulation import mean_commands, step_commands


def test_delayed_command_counts_by_its_share_of_a_step():
    """A command 0 → 1 at 0.1 s arrives at 0.112 s: it holds for 8 of the 10 ms from 0.11 s."""
    edges = np.array((0.09, 0.10, 0.11, 0.12, 0.13))
    t_cmd, q_cmd = np.array((0.0, 0.1)), np.array(((0.0, 5.0), (1.0, 5.0)))
    mean = mean_commands(t_cmd, q_cmd, edges, np.array((0.012, 0.3)))
    np.testing.assert_allclose(mean[:, 0], (0.0, 0.0, 0.8, 1.0), atol=1e-9)
    np.testing.assert_allclose(mean[:, 1], 5.0)


def test_a_step_knows_what_arrives_before_and_after_a_jump():
    """As above; three commands in one step, 0, 1 and 5 for 2, 4 and 4 ms, keep their mean."""
    edges, latency = np.array((0.10, 0.11, 0.12, 0.13)), np.array((0.012,))
    t_cmd, q_cmd = np.array((0.0, 0.1)), np.array(((0.0,), (1.0,)))
    first, jump, last = step_commands(t_cmd, q_cmd, edges, latency)[..., 0]
    np.testing.assert_allclose(jump, (0.8, -0.8, 0.2, 0.2), atol=1e-9)
    np.testing.assert_allclose((first[:3], last[:3]), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), atol=1e-9)
    t_cmd, q_cmd = np.array((0.0, 0.1, 0.104)), np.array(((0.0,), (1.0,), (5.0,)))
    crowded = step_commands(t_cmd, q_cmd, edges, latency)[1, :, 0]
    np.testing.assert_allclose(crowded[0], 0.2 * 0.0 + 0.4 * 1.0 + 0.4 * 5.0)
