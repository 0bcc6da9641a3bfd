"""Following the object through a whole stream of images, and what is to be said about it afterwards."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixel2catch.camera.boxes import PIXEL_FEATURES
from pixel2catch.perception.extractor import Extraction, Percentiles, PixelFeatureExtractor, StageClock
from pixel2catch.perception.plausibility import Verdict
from pixel2catch.perception.sources import Tick
from pixel2catch.scene.constants import CONTROL_DT

STAGES = ("robot", "segment", "box", "total")
"""Stages of the extractor, in the order in which they run."""

LOOKED = "segment"  #: The stage that runs whenever an image was looked at; other control steps cost nothing.
BOX_EDGES = ("xmin", "ymin", "xmax", "ymax")

COLUMNS = (
    *("time", "stamp", *BOX_EDGES, *PIXEL_FEATURES, "verdict", "is_valid", "is_fresh", "age", "score"),
    *("source", "doubt", "num_skipped", *(f"{stage}_ms" for stage in STAGES), "message"),
)
"""Columns of a table of sightings: box, differences [px], centre and size as shares, times [s] or [ms]."""


@dataclass(frozen=True, kw_only=True)
class Sighting:
    """One control step."""

    tick: Tick  #: The image, and the time.
    time: float  #: Since the first control step [s].
    extraction: Extraction  #: What was seen.
    durations: dict[str, float]  #: How long each stage took [s]; without those that did not run.

    def row(self) -> dict[str, Any]:
        """The sighting as a row of a table, by `COLUMNS`."""
        seen = self.extraction
        times = {f"{stage}_ms": f"{1e3 * took:.3f}" for stage, took in self.durations.items()}
        numbers = {
            "time": f"{self.time:.4f}",
            "stamp": f"{self.tick.frame.stamp:.6f}",
            "age": f"{seen.age:.4f}",
            "score": f"{seen.score:.4f}",
        }
        box = {name: f"{value:g}" for name, value in zip(BOX_EDGES, seen.box[0].tolist(), strict=True)}
        features = zip(PIXEL_FEATURES, seen.features[0].tolist(), strict=True)
        others = ("verdict", "is_valid", "is_fresh", "source", "doubt", "num_skipped", "message")
        row = numbers | box | times | {name: getattr(seen, name) for name in others}
        return row | {name: f"{value:.6g}" for name, value in features}


def follow(ticks: Iterable[Tick], extractor: PixelFeatureExtractor, begin: float = 0.0) -> Iterator[Sighting]:
    """Yield what is seen in every control step; a throw begins, with a reset, so long after the start [s].

    Raises:
        PerceptionError: If the first image has the wrong size.
    """
    first: Tick | None = None
    has_begun = False
    for tick in ticks:
        first = first or tick
        if not has_begun and tick.frame.stamp - first.frame.stamp >= begin - 0.5 * CONTROL_DT:
            extractor.reset()
            has_begun = True
        extractor.clock = StageClock()
        extraction = extractor.step(tick.frame, tick.now)
        durations = {name: report.p50 for name, report in extractor.clock.percentiles().items()}
        yield Sighting(tick=tick, time=tick.now - first.now, extraction=extraction, durations=durations)


class Tally:
    """Counts sightings, also those without joint positions, and measures how long they took."""

    def __init__(self) -> None:
        """Begin with none."""
        self.num_steps = self.num_without_joints = 0
        self._verdicts: Counter[Verdict] = Counter()
        self._sources: Counter[str] = Counter()
        self._doubts: Counter[str] = Counter()
        self._durations: dict[str, list[float]] = {}
        self._num_valid = self._num_seen = self._num_skipped = self._num_identical = 0
        self._last_image: np.ndarray | None = None
        self._longest_pause = self._seconds = 0.0

    def add(self, sighting: Sighting) -> None:
        """Count one more."""
        seen, frame = sighting.extraction, sighting.tick.frame
        self.num_steps += 1
        self.num_without_joints += frame.joint_pos is None
        self._verdicts[seen.verdict] += 1
        if seen.source:
            self._sources[f"{seen.source} ({seen.doubt})" if seen.doubt else seen.source] += 1
        elif seen.doubt:
            self._doubts[seen.doubt] += 1
        self._seconds = sighting.time
        self._num_skipped += seen.num_skipped
        self._longest_pause = max(self._longest_pause, sighting.tick.now - frame.stamp)
        if seen.verdict is Verdict.REPEATED:
            return
        self._num_valid += seen.is_valid
        self._num_seen += seen.verdict is Verdict.SEEN
        self._num_identical += self._last_image is not None and np.array_equal(frame.image, self._last_image)
        self._last_image = frame.image
        if LOOKED in sighting.durations:
            for stage, took in sighting.durations.items():
                self._durations.setdefault(stage, []).append(took)

    def percentiles(self) -> dict[str, Percentiles]:
        """Durations of the stages, over the control steps in which an image was looked at."""
        return {stage: Percentiles.of(self._durations[stage]) for stage in STAGES if stage in self._durations}

    @property
    def is_fast_enough(self) -> bool:
        """Whether 99 % of the images took less than a control step."""
        report = self.percentiles()
        return "total" in report and report["total"].p99 < CONTROL_DT

    def summary(self) -> dict[str, Any]:
        """The numbers for programs; times [s] and durations [ms]."""
        stages = {
            name: {"p50": 1e3 * p.p50, "p95": 1e3 * p.p95, "p99": 1e3 * p.p99, "count": p.count}
            for name, p in self.percentiles().items()
        }
        return {
            "num_steps": self.num_steps,
            "seconds": self._seconds,
            "verdicts": {str(verdict): count for verdict, count in self._verdicts.most_common()},
            "believed": dict(self._sources.most_common()),
            "doubts": dict(self._doubts.most_common()),
            "seen_since_first": self._num_seen / self._num_valid if self._num_valid else None,
            "num_skipped": self._num_skipped,
            "num_identical": self._num_identical,
            "longest_pause": self._longest_pause,
            "stages_ms": stages,
            "limit_ms": 1e3 * CONTROL_DT,
            "is_fast_enough": self.is_fast_enough,
        }
