"""Rollout memory whose mini-batches are drawn on the device."""

from collections.abc import Iterator
from typing import Any

import torch
from skrl.memories.torch import Memory
from torch import Tensor


class RolloutMemory(Memory):
    """Memory of one rollout.

    skrl's own random memory permutes on the host and copies the indices of every tensor of every mini-batch
    to the device; this one permutes on the device and gathers a mini-batch when it is needed.

    Attributes:
        extra: What skrl does not know of the next transition, by the name of its tensor.
    """

    def __init__(self, **arguments: Any) -> None:
        """Build skrl's memory."""
        super().__init__(**arguments)
        self.extra: dict[str, Tensor] = {}

    def add_samples(self, **tensors: Any) -> None:
        """Remember a transition, with what is in `extra`."""
        super().add_samples(**tensors, **self.extra)  # pyright: ignore[reportArgumentType] (annotated wrongly)

    def sample(  # pyright: ignore[reportIncompatibleMethodOverride] (an iterator is all that skrl needs)
        self, names: list[str], *, batch_size: int, mini_batches: int = 1, sequence_length: int = 1
    ) -> Iterator[list[Tensor]]:
        """Yield random mini-batches which together hold every transition once.

        Args:
            names: Names of the tensors to gather.
            batch_size: Number of transitions to draw; skrl asks for all.
            mini_batches: Number of mini-batches.
            sequence_length: 1; these networks have no memory.
        """
        order = torch.randperm(len(self), device=self.device)[:batch_size]
        for indices in order.chunk(mini_batches):
            yield [self.tensors_view[name].index_select(0, indices) for name in names]
