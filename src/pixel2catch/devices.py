"""Constants, uniform draws and time on the device that computes."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, final

import torch
from jaxtyping import Float
from torch import Tensor

Constants = dict[tuple[Any, ...], Tensor]
"""Tensors by their values, dtype and device.

A recorded CUDA graph reads constants at the addresses of the recording. They must live as long as the graph,
which cannot copy them from the host: its owner keeps them.
"""

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
    kept, key = _KEPT.get(), (values, dtype, device)
    kept = {} if kept is None else kept
    if key not in kept:
        kept[key] = torch.tensor(values, dtype=dtype, device=device)
    return kept[key]


def uniform(
    ranges: tuple[tuple[float, float], ...], num_rows: int, generator: torch.Generator
) -> Float[Tensor, "num_rows num_ranges"]:
    """Return independent uniform draws, one column per range, on the generator's device."""
    lower, upper = constant(ranges, generator.device).T
    draws = torch.rand(num_rows, len(ranges), generator=generator, device=generator.device)
    return lower + (upper - lower) * draws


@final
class DeviceTime:
    """The time at which a device has finished its earlier work; only a comparison waits for it."""

    def __init__(self, device: torch.device | str) -> None:
        self._event = None
        if torch.device(device).type == "cuda":
            self._event = torch.cuda.Event(enable_timing=True)
            self._event.record()
        self._time = time.perf_counter()

    def until(self, later: "DeviceTime") -> float:
        """Return the time to a later event of the same device [s]; wait for that event."""
        if self._event is None or later._event is None:
            return later._time - self._time
        later._event.synchronize()
        return self._event.elapsed_time(later._event) / 1e3
