"""Errors of the boxes of a video: while the object is held, in flight, near the hand."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np

from pixel2catch.camera.image import Edges, Verdict
from pixel2catch.evaluation.metrics import rate
from pixel2catch.perception.labels import PHASES, Labels, Phase, Truth
from pixel2catch.perception.sightings import Sighting
from pixel2catch.perception.sources import ImageFit

GOOD = 5.0
"""Largest error of an edge that is good enough [px]. Source: the noise of training."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """The score of one image."""

    phase: Phase  #: Of the throw.
    is_visible: bool  #: Whether enough of the object is visible.
    is_seen: bool  #: Whether a box was found in this image.
    error: float  #: Error of the worst edge of the policy's box, new or held [px]; NaN if not visible.
    is_apart: bool  #: Whether that box and the object do not overlap.

    @property
    def is_good(self) -> bool:
        """Whether the box was found and is accurate."""
        return self.is_seen and self.error <= GOOD


def score_box(truth: Truth, box: Edges, *, is_seen: bool = True) -> Score:
    """Compare a box with the truth; `is_seen` is false for a box of an earlier image."""
    if truth.box is None:
        return Score(phase=truth.phase, is_visible=False, is_seen=is_seen, error=float("nan"), is_apart=True)
    error = max(abs(edge - true) for edge, true in zip(box, truth.box, strict=True))
    is_apart = any(min(box[i + 2], truth.box[i + 2]) <= max(box[i], truth.box[i]) for i in range(2))
    return Score(phase=truth.phase, is_visible=True, is_seen=is_seen, error=error, is_apart=is_apart)


def scored(
    sightings: Iterable[Sighting], labels: Labels, fit: ImageFit, begin: float, scores: list[Score]
) -> Iterator[Sighting]:
    """Yield the sightings of a video, and add a score for each labelled image; labels are in its own pixels.

    Errors are in pixels of the scaled images. Images before the object was pointed out do not count
    (`begin` [s since the first image]).
    """
    for sighting in sightings:
        label = labels.at(sighting.tick.image.stamp)
        if label and sighting.box.verdict is not Verdict.REPEATED and sighting.time >= begin:
            truth = Truth(phase=label.phase, box=label.box and fit.box(label.box))
            scores.append(score_box(truth, sighting.box.edges, is_seen=sighting.box.verdict is Verdict.SEEN))
        yield sighting


def summary(scores: Iterable[Score]) -> dict[str, dict[str, Any]]:
    """Return rates and errors [px] in every phase, over the images in which the object is visible."""
    rows = list(scores)
    return {phase: _summary([each for each in rows if each.phase == phase]) for phase in PHASES}


def _summary(rows: list[Score]) -> dict[str, Any]:
    visible = [each for each in rows if each.is_visible]
    errors = [each.error for each in visible if each.is_seen]
    report: dict[str, Any] = {"images": len(visible), "hidden": len(rows) - len(visible)}
    report["seen_though_hidden"] = sum(each.is_seen for each in rows if not each.is_visible)
    report["false_boxes"] = sum(each.is_seen and each.is_apart for each in rows)
    if not visible:
        return report
    num_good = sum(each.is_good for each in visible)
    report["detected"] = len(errors) / len(visible)
    report |= rate("within_5px", num_good, len(visible))
    pairs = enumerate(pairwise(visible), start=1)
    losses = [i for i, (before, now) in pairs if before.is_good and not now.is_good]
    waits = [wait for i in losses if (wait := reacquisition(visible, i)) is not None]
    report |= {"losses": len(losses), "reacquisitions": len(waits)}
    report |= {"reacquisition_images_p50": median(waits)} if waits else {}
    for name, values in (("error", errors), ("delivered_error", [each.error for each in visible])):
        if values:
            report[f"{name}_p50"], report[f"{name}_p95"] = np.percentile(values, (50, 95)).tolist()
    return report


def reacquisition(scores: Sequence[Score], first: int) -> int | None:
    """Return the number of images until the object is found, from the first in which it is visible again.

    None if it is not found before the end of the film.
    """
    return next((i - first for i in range(first, len(scores)) if scores[i].is_good), None)
