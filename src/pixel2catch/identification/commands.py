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
