"""Constant tensors on a device, kept alive by the owner of a CUDA graph.

A recorded CUDA graph reads constants at the addresses of the recording. They must live as long as the graph,
which cannot copy them from the host.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor

Constants = dict[tuple[Any, ...], Tensor]
"""Tensors by their values, dtype and device."""

_KEPT: ContextVar[Constants | None] = ContextVar("_KEPT", default=None)


@contextmanager
def keeping(constants: Constants) -> Iterator[None]:
    """Make each constant once in this context and keep it in a dictionary."""
    token = _KEPT.set(constants)
    try:
        yield
    finally:
        _KEPT.reset(token)


def constant(values: tuple[Any, ...], device: torch.device, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return a tensor of numbers, or of nested tuples of numbers. Do not write to it."""
    kept = _KEPT.get()
    if kept is None:
        return torch.tensor(values, dtype=dtype, device=device)
    key = (values, dtype, device)
    if key not in kept:
        kept[key] = torch.tensor(values, dtype=dtype, device=device)
    return kept[key]
