"""Numbers as tensors on a device, kept by whoever goes on reading them.

A recorded CUDA graph reads its constants from where they were when it was recorded: they must not be freed
before it, and it cannot copy them from the host.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor

Constants = dict[tuple[Any, ...], Tensor]
"""Tensors by the numbers that are in them, dtype and device."""

_KEPT: ContextVar[Constants | None] = ContextVar("_KEPT", default=None)


@contextmanager
def keeping(constants: Constants) -> Iterator[None]:
    """Within it, a constant is made once and kept in the dictionary, whose owner keeps it alive."""
    token = _KEPT.set(constants)
    try:
        yield
    finally:
        _KEPT.reset(token)


def constant(values: tuple[Any, ...], device: torch.device, dtype: torch.dtype = torch.float32) -> Tensor:
    """A tensor of these numbers, which nobody may change.

    Args:
        values: Numbers, or tuples of them, or of those.
        device: Where it shall be.
        dtype: Its type.
    """
    kept = _KEPT.get()
    if kept is None:
        return torch.tensor(values, dtype=dtype, device=device)
    key = (values, dtype, device)
    if key not in kept:
        kept[key] = torch.tensor(values, dtype=dtype, device=device)
    return kept[key]
