"""A line of values on their way: what arrives now was sent some control steps ago."""

from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.mdp.masks import select

T = TypeVar("T")


@dataclass(frozen=True)
class DelayLine(Generic[T]):
    """Values on their way, tensors or dataclasses of tensors: the newest and its predecessors."""

    ages: tuple[T, ...]  #: Values by age in control steps, newest first.

    def delivered(self, delay: Float[Tensor, " num_envs"]) -> T:
        """The value that is `delay` control steps old, or the next newer one where there is none."""
        result = self.ages[0]
        for age, value in enumerate(self.ages[1:], start=1):
            result = select(delay >= age, value, result)
        return result

    def interpolated(self: "DelayLine[Tensor]", delay: Float[Tensor, " num_envs"]) -> Tensor:
        """Values (num_envs, k) that are `delay` control steps old, linear between those that were sent."""
        ages = torch.stack(self.ages, dim=1)
        distance = delay[:, None] - torch.arange(len(self.ages), device=delay.device)
        return (torch.clamp(1.0 - distance.abs(), min=0.0)[..., None] * ages).sum(dim=1)

    def pushed(self, value: T) -> "DelayLine[T]":
        """The line one control step later."""
        return DelayLine((value, *self.ages[:-1]))

    @classmethod
    def filled(cls, value: T, longest: int) -> "DelayLine[T]":
        """A line for delays of up to `longest`, in which every age is the same: how an episode begins."""
        return cls((value,) * (longest + 1))

    @property
    def newest(self) -> T:
        """The value that was sent last."""
        return self.ages[0]
