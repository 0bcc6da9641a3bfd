"""Rollout memory whose mini-batches are drawn on the device."""

from collections.abc import Iterator

import torch
from skrl.memories.torch import Memory
from torch import Tensor


class RolloutMemory(Memory):
    """Memory of one rollout.

    skrl's own random memory permutes on the host and copies the indices of every tensor of every mini-batch
    to the device; this one permutes on the device and gathers a mini-batch when it is needed.
    """

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
