"""Following the object through a stream of images: a row, a picture and a summary of what was seen."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from pixel2catch.camera.image import Box, Verdict
from pixel2catch.mdp.observations import PIXEL_FEATURES, pixel_features
from pixel2catch.perception.sources import Tick
from pixel2catch.perception.tracker import ObjectTracker
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

LARGEST_AGE = 2.5 * CONTROL_DT  #: Of a fresh box [s]. Source: release; in training they are 1 or 2 steps old.
LARGEST_GAP = 1.75  #: Longest interval between images without a lost one, in usual ones. Source: ours.
SLOWEST = 1.3 * CONTROL_DT  #: Longest usual interval between images of a suitable camera [s]. Source: ours.
STAGES = ("robot", "segment", "box", "total")  #: Timed stages of the tracker, in order; total has all.
BOX_EDGES = ("xmin", "ymin", "xmax", "ymax")

COLUMNS = (
    *("time", "stamp", *BOX_EDGES, *PIXEL_FEATURES, "verdict", "is_valid", "is_fresh", "age", "score"),
    *("doubt", "num_skipped", *(f"{stage}_ms" for stage in STAGES), "message"),
)
"""Columns of a table of sightings: box and differences [px], centre and size as shares, times [s] or [ms]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """One control step."""

    tick: Tick  #: The image, and the time.
    time: float  #: Since the first control step [s].
    box: Box  #: What was found.
    #: Pixel features of this box and that of the step before; the first box of a throw is its predecessor.
    features: tuple[float, ...]
    num_skipped: int  #: Control steps without an image since the last one; differences span them.
    durations: dict[str, float]  #: Duration of each stage that ran [s].

    @property
    def is_fresh(self) -> bool:
        """Whether the box is no older than those of training."""
        return self.box.age <= LARGEST_AGE

    def row(self) -> dict[str, Any]:
        """Return the row of a table, by `COLUMNS`."""
        box = self.box
        row: dict[str, Any] = {"is_fresh": self.is_fresh, "num_skipped": self.num_skipped}
        row |= {"time": f"{self.time:.4f}", "stamp": f"{box.stamp:.6f}"}
        row |= {"age": f"{box.age:.4f}", "score": f"{box.score:.4f}"}
        row |= {name: f"{value:g}" for name, value in zip(BOX_EDGES, box.edges, strict=True)}
        row |= {f"{stage}_ms": f"{1e3 * took:.3f}" for stage, took in self.durations.items()}
        row |= {name: getattr(box, name) for name in ("verdict", "is_valid", "doubt", "message")}
        return row | {name: f"{value:.6g}" for name, value in zip(PIXEL_FEATURES, self.features, strict=True)}


def follow(
    ticks: Iterable[Tick], tracker: ObjectTracker, begin: float = 0.0, camera: CameraSpec = RGB_CAMERA
) -> Iterator[Sighting]:
    """Yield a sighting in every control step; the throw begins, with a reset, so late after the first [s]."""
    start: Tick | None = None
    has_begun = False
    before, newest = Box(verdict=Verdict.NO_IMAGE), -inf
    for tick in ticks:
        start, stamp = start or tick, tick.image.stamp
        if not has_begun and stamp - start.image.stamp >= begin - 0.5 * CONTROL_DT:
            tracker.reset()
            has_begun, before, newest = True, Box(verdict=Verdict.NO_IMAGE), -inf
        box = tracker.step(tick.image, tick.now)
        is_next = stamp > newest > -inf
        first = before if before.is_valid else box
        features = pixel_features(torch.tensor([first.edges]), torch.tensor([box.edges]), camera)
        yield Sighting(
            tick=tick,
            time=tick.now - start.now,
            box=box,
            features=tuple(features[0].tolist()),
            num_skipped=max(round((stamp - newest) / CONTROL_DT) - 1, 0) if is_next else 0,
            durations=tracker.durations,
        )
        before, newest = box, max(newest, stamp)


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the numbers of a table of sightings for programs.

    It is fast enough if 99 % of the images that were processed took less than a control step.
    """
    new = [row for row in rows if row["verdict"] is not Verdict.REPEATED]
    stages = {}
    for stage in STAGES:
        durations = [float(row[f"{stage}_ms"]) for row in new if {"segment_ms", f"{stage}_ms"} <= row.keys()]
        if durations:
            p50, p95, p99 = np.percentile(durations, (50, 95, 99)).tolist()
            stages[stage] = {"p50": p50, "p95": p95, "p99": p99, "count": len(durations)}
    num_valid = sum(row["is_valid"] for row in new)
    num_seen = sum(row["verdict"] is Verdict.SEEN for row in new)
    return {
        "num_steps": len(rows),
        "seconds": float(rows[-1]["time"]) if rows else 0.0,
        "verdicts": dict(Counter(str(row["verdict"]) for row in rows).most_common()),
        "doubts": dict(Counter(row["doubt"] for row in rows if row["doubt"]).most_common()),
        "seen_since_first": num_seen / num_valid if num_valid else None,
        "num_skipped": sum(row["num_skipped"] for row in rows),
        "stages_ms": stages,
        "limit_ms": 1e3 * CONTROL_DT,
        "is_fast_enough": "total" in stages and stages["total"]["p99"] < 1e3 * CONTROL_DT,
    }


def rate_notes(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield what the stamps in a table of sightings show, with its remedy: lost images, and a low rate."""
    stamps = [float(row["stamp"]) for row in rows if row["verdict"] is not Verdict.REPEATED]
    if len(stamps) < 3:
        return
    intervals = np.diff(stamps)
    usual = float(np.median(intervals))
    gaps = intervals[intervals > LARGEST_GAP * usual]
    if len(gaps):
        yield (
            f"{len(gaps)} gaps in the stamps, of up to {1e3 * gaps.max():.0f} ms, where images are "
            f"{1e3 * usual:.0f} ms apart: images are lost. Connect the camera alone to a USB 3 port, and "
            "close programs that use processor or disk."
        )
    if usual > SLOWEST:
        yield (
            f"{1.0 / usual:.0f} images a second, policies expect {1.0 / CONTROL_DT:.0f}: set the camera's "
            f"rate, and expose for less than {1e3 * CONTROL_DT:.0f} ms, also in dim light."
        )


#: Colours of a new box, of a held one, of one that is too old, of text without a box, and of the outline.
SEEN, HELD, STALE, UNKNOWN = (80, 255, 80), (255, 190, 60), (255, 80, 80), (120, 120, 120)
OUTLINE = (255, 80, 255)
HEADER = 24  #: Height of the line of text [px].


def annotated(sighting: Sighting, camera: CameraSpec = RGB_CAMERA) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return the image with box and outline, and a line of text above; an image of another size is black."""
    box, held = sighting.box, HELD if sighting.is_fresh else STALE
    color = (SEEN if box.verdict is Verdict.SEEN else held) if box.is_valid else UNKNOWN
    age = f"{1e3 * box.age:.0f} ms old" if box.is_valid else "never seen"
    took = f"{1e3 * sighting.durations.get('total', 0.0):.1f} ms"
    words = [f"{sighting.time:7.2f} s", str(box.verdict), age, f"score {box.score:.2f}", took, box.doubt]
    header = np.zeros((HEADER, camera.width, 3), dtype=np.uint8)
    place, font = (8, HEADER - 8), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(header, "   ".join(words), place, font, 0.42, color, 1, cv2.LINE_AA)
    image, pixels = np.zeros((camera.height, camera.width, 3), dtype=np.uint8), sighting.tick.image.pixels
    if pixels.shape == image.shape:
        image[:] = pixels
        if box.mask is not None:
            mask = box.mask.view(np.uint8)
            outline, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(image, outline, -1, OUTLINE, 1)
        if box.is_valid:
            xmin, ymin, xmax, ymax = map(round, box.edges)
            cv2.rectangle(image, (xmin - 1, ymin - 1), (xmax, ymax), color, 1)
    return np.concatenate([header, image])
