"""Throws as states: the robot that the policy moves, and the object, to be filmed afterwards."""

from dataclasses import dataclass

import numpy as np
import torch

from pixel2catch.envs.step import Step
from pixel2catch.evaluation.protocol import EvaluationCfg
from pixel2catch.evaluation.rendered.camera import OBJECT, Moment
from pixel2catch.evaluation.rounds import Actor, RoundState, run_round
from pixel2catch.methods import Method
from pixel2catch.robot.constants import CONTROL_DT

LEAST_SPEED = 0.5
"""Speed from which an object flies [m/s]."""


@dataclass(frozen=True, kw_only=True)
class ThrowTake:
    """One throw, until the success or the end.

    Attributes:
        object_name: What was thrown.
        moments: The state at every control step.
    """

    object_name: str
    moments: tuple[Moment, ...]


def record_throws(cfg: EvaluationCfg, actor: Actor, method: Method) -> list[ThrowTake]:
    """Play one round with boxes from geometry, and keep the states.

    Args:
        cfg: What is thrown; one round of it.
        actor: The policy.
        method: The method that it was trained with.
    """
    env = cfg.make_env(method)
    live = [env.world.simulation.bind(name) for name in ("qpos", "qvel")]
    states: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []

    def watch(_: Step, state: RoundState) -> None:
        qpos, qvel = (values.cpu().clone() for values in live)
        states.append((qpos, qvel, (state.is_running & ~state.is_testing).cpu()))

    try:
        object_ids = run_round(env, actor, watch).record.object_id.tolist()
        names = [env.world.objects.names[row] for row in object_ids]
    finally:
        env.close()
    takes = []
    for i, name in enumerate(names):
        kept = [(qpos[i].numpy(), qvel[i].numpy()) for qpos, qvel, is_running in states if is_running[i]]
        takes.append(ThrowTake(object_name=name, moments=_moments(kept)))
    return takes


def _moments(states: list[tuple[np.ndarray, np.ndarray]]) -> tuple[Moment, ...]:
    """The states with their times since the release."""
    flying = (i for i, (_, qvel) in enumerate(states) if np.linalg.norm(qvel[OBJECT]) > LEAST_SPEED)
    release = next(flying, len(states))
    return tuple(
        Moment(qpos=qpos, qvel=qvel, time=(i - release) * CONTROL_DT) for i, (qpos, qvel) in enumerate(states)
    )
