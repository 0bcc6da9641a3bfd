"""Time measurement on the device that computes."""

import time
from typing import final

import torch


@final
class DeviceTime:
    """The time at which a device has finished its earlier work; only a comparison waits for it."""

    def __init__(self, device: torch.device | str) -> None:
        """Record an event on a CUDA device, or the time on the CPU."""
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
