"""How long each stage of the perception takes."""

import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

MEMORY = 10_000  #: Durations that are kept of each stage: five minutes at 30 Hz.


@dataclass(frozen=True, kw_only=True)
class Percentiles:
    """Durations of one stage [s]: half of them, 95 % and 99 % were shorter; and how many there were."""

    p50: float
    p95: float
    p99: float
    count: int

    @classmethod
    def of(cls, durations: Iterable[float]) -> "Percentiles":
        """Those of some durations [s]."""
        values = list(durations)
        p50, p95, p99 = np.percentile(values, (50, 95, 99)).tolist()
        return cls(p50=p50, p95=p95, p99=p99, count=len(values))


class StageClock:
    """Measures named stages and keeps their latest durations."""

    def __init__(self) -> None:
        """Begin with no stage."""
        self._durations: dict[str, deque[float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure what runs in this context, be it left by an error."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._durations.setdefault(name, deque(maxlen=MEMORY)).append(time.perf_counter() - begin)

    def percentiles(self) -> dict[str, Percentiles]:
        """Durations by stage, in the order in which the stages first ended."""
        return {name: Percentiles.of(durations) for name, durations in self._durations.items()}
