"""A line of values on their way: what arrives now was sent some control steps ago."""

from dataclasses import dataclass
from typing import Generic, TypeVar

from jaxtyping import Int
from torch import Tensor

from pixel2catch.mdp.masks import select

T = TypeVar("T")


@dataclass(frozen=True)
class DelayLine(Generic[T]):
    """Values on their way, tensors or dataclasses of tensors: the newest and its predecessors.

    Attributes:
        ages: Values by age in control steps, newest first.
    """

    ages: tuple[T, ...]

    def delivered(self, delay: Int[Tensor, " num_envs"]) -> T:
        """The value that is `delay` control steps old."""
        result = self.ages[0]
        for age, value in enumerate(self.ages[1:], start=1):
            result = select(delay >= age, value, result)
        return result

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
