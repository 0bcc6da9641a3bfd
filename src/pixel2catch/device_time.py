"""Times by the clock of the device that computes."""

import time
from typing import final

import torch


@final
class DeviceTime:
    """The moment when a device has done what it was given before; nothing waits until times are compared."""

    def __init__(self, device: torch.device | str) -> None:
        """Mark this moment; on the CPU, what was given before has been done."""
        self._event = None
        if torch.device(device).type == "cuda":
            self._event = torch.cuda.Event(enable_timing=True)
            self._event.record()
        self._time = time.perf_counter()

    def until(self, later: "DeviceTime") -> float:
        """Time to a later moment of the same device [s]; waits for that one."""
        if self._event is None or later._event is None:
            return later._time - self._time
        later._event.synchronize()
        return self._event.elapsed_time(later._event) / 1e3
