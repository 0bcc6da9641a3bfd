"""Policies whose actions are known."""

from collections.abc import Callable

import torch
from torch import Tensor


class Scripted:
    """Acts as a function of the number of the control step, from 1: a value for the arm, one for the hand."""

    def __init__(self, script: Callable[[int], tuple[float, float]]) -> None:
        self._script, self._steps = script, 0

    def act(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        self._steps += 1
        arm, hand = self._script(self._steps)
        num_envs = len(observations["arm"])
        return {"arm": torch.full((num_envs, 6), arm), "hand": torch.full((num_envs, 13), hand)}


def still() -> Scripted:
    return Scripted(lambda _: (0.0, 0.0))


def grasp(closes_at: int) -> Scripted:
    """Keeps the arm where it is, opens the hand, and closes it at a given control step."""
    return Scripted(lambda step: (0.0, 1.0 if step >= closes_at else -1.0))
