"""Recorded commands, as the simulation of a recording needs them."""

import numpy as np
from jaxtyping import Float


def mean_commands(
    t_cmd: Float[np.ndarray, " num_commands"],
    q_cmd: Float[np.ndarray, "num_commands num_joints"],
    edges: Float[np.ndarray, " num_edges"],
    latency: Float[np.ndarray, " num_joints"],
) -> Float[np.ndarray, "num_steps num_joints"]:
    """Mean of the held, delayed commands over every time step: it depends smoothly on the latency.

    Args:
        t_cmd: When each command was sent [s].
        q_cmd: The commands [rad]; the first also holds before it was sent.
        edges: Starts of the steps, and the end of the last [s].
        latency: Delay of each joint's commands [s].
    """
    end = max(float(edges[-1]), float(t_cmd[-1])) + 1.0
    start = min(float(edges[0]) - float(latency.max()), float(t_cmd[0])) - 1.0
    knots = np.concatenate(([start], t_cmd, [end]))
    held = np.concatenate((q_cmd[:1], q_cmd))
    area = np.concatenate((np.zeros((1, held.shape[1])), np.cumsum(np.diff(knots)[:, None] * held, axis=0)))
    areas = [np.interp(edges - delay, knots, area[:, j]) for j, delay in enumerate(latency)]
    return np.diff(np.stack(areas, axis=-1), axis=0) / np.diff(edges)[:, None]


def step_commands(
    t_cmd: Float[np.ndarray, " num_commands"],
    q_cmd: Float[np.ndarray, "num_commands num_joints"],
    edges: Float[np.ndarray, " num_edges"],
    latency: Float[np.ndarray, " num_joints"],
) -> Float[np.ndarray, "num_steps 4 num_joints"]:
    """What arrives in every time step: a command, and from some moment on the next one.

    A servo at its torque limit does not answer to their mean, so that the moment must be known. Where several
    commands of a step are no such pair, there is their mean only.

    Args:
        t_cmd: As of `mean_commands`, and so are the others.
        q_cmd: The commands [rad].
        edges: Starts of the steps, and the end of the last [s].
        latency: Delay of each joint's commands [s].

    Returns:
        Their mean [rad]; by how much the first and the last are beyond it [rad]; the share of the first.
    """
    mean = mean_commands(t_cmd, q_cmd, edges, latency)
    sent = np.searchsorted(t_cmd, edges[:, None] - latency, side="right") - 1
    held = np.take_along_axis(q_cmd, np.maximum(sent, 0), axis=0)
    first, last = held[:-1] - mean, held[1:] - mean
    jump = first - last
    share = np.divide(-last, jump, out=np.full_like(mean, -1.0), where=jump != 0.0)
    is_pair = (share >= 0.0) & (share <= 1.0)
    columns = (mean, is_pair * first, is_pair * last, np.where(is_pair, share, 0.5))
    return np.stack(columns, axis=1)
