"""How right the boxes of a video are: while the object is held, in flight, near the hand."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np

from pixel2catch.camera.image import Box, Edges, Verdict
from pixel2catch.evaluation.metrics import wilson_interval
from pixel2catch.perception.labels import PHASES, Labels, Phase, Truth
from pixel2catch.perception.sightings import Sighting
from pixel2catch.perception.sources import ImageFit

GOOD = 5.0
"""Largest error of an edge that is good enough [px]. Source: the noise of training."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """What became of one image."""

    phase: Phase  #: Of the throw.
    is_visible: bool  #: Whether there was enough of the object to see.
    is_seen: bool  #: Whether a box was found in this image.
    #: Of the worst edge of the box that the policy gets, be it new or held [px]; no number where the object
    #: is not visible.
    error: float
    is_apart: bool  #: Whether that box and the object have no point in common.

    @property
    def is_good(self) -> bool:
        """Whether the object was found where it is."""
        return self.is_seen and self.error <= GOOD

    @property
    def is_false(self) -> bool:
        """Whether a box was found, but none of the object."""
        return self.is_seen and self.is_apart


def score(truth: Truth, seen: Box) -> Score:
    """Compare what was seen in an image with the truth."""
    return score_box(truth, seen.edges, is_seen=seen.verdict is Verdict.SEEN)


def score_box(truth: Truth, box: Edges, *, is_seen: bool = True) -> Score:
    """Compare a box with the truth; it is an older one where nothing was seen."""
    if truth.box is None:
        return Score(phase=truth.phase, is_visible=False, is_seen=is_seen, error=float("nan"), is_apart=True)
    error = max(abs(edge - true) for edge, true in zip(box, truth.box, strict=True))
    is_apart = any(min(box[i + 2], truth.box[i + 2]) <= max(box[i], truth.box[i]) for i in range(2))
    return Score(phase=truth.phase, is_visible=True, is_seen=is_seen, error=error, is_apart=is_apart)


def scored(
    sightings: Iterable[Sighting], labels: Labels, fit: ImageFit, begin: float, scores: list[Score]
) -> Iterator[Sighting]:
    """Yield sightings as they come, and add a score for each labelled image that was looked at.

    Args:
        sightings: Of a video.
        labels: Of that video, in its own pixels.
        fit: How its images were made to fit; errors are in pixels of the images that were looked at.
        begin: When the object was pointed out [s since the first image]; earlier images do not count.
        scores: What is added to.
    """
    for sighting in sightings:
        label = labels.at(sighting.tick.image.stamp)
        is_counted = sighting.box.verdict is not Verdict.REPEATED and sighting.time >= begin
        if label is not None and is_counted:
            truth = Truth(phase=label.phase, box=label.box and fit.box(label.box))
            scores.append(score(truth, sighting.box))
        yield sighting


def summary(scores: Iterable[Score]) -> dict[str, dict[str, Any]]:
    """Rates and errors [px] in every phase, over the images in which the object is visible."""
    rows = list(scores)
    return {phase: _summary([each for each in rows if each.phase == phase]) for phase in PHASES}


def _summary(rows: list[Score]) -> dict[str, Any]:
    visible = [each for each in rows if each.is_visible]
    errors = [each.error for each in visible if each.is_seen]
    delivered = [each.error for each in visible]
    report: dict[str, Any] = {"images": len(visible), "hidden": len(rows) - len(visible)}
    report["seen_though_hidden"] = sum(each.is_seen for each in rows if not each.is_visible)
    report["false_boxes"] = sum(each.is_false for each in rows)
    if not visible:
        return report
    num_good = sum(each.is_good for each in visible)
    report["detected"] = len(errors) / len(visible)
    report["within_5px"] = num_good / len(visible)
    report["within_5px_interval"] = list(wilson_interval(num_good, len(visible)))
    report |= _reacquisitions(visible)
    names = ("p50", "p95")
    for name, values in (("error", errors), ("delivered_error", delivered)):
        if values:
            quantiles = np.percentile(values, (50, 95)).tolist()
            report |= {f"{name}_{p}": value for p, value in zip(names, quantiles, strict=True)}
    return report


def _reacquisitions(visible: list[Score]) -> dict[str, Any]:
    """How often the object was lost while it was visible, and how many images that took, where it ended."""
    losses = [
        i for i, (before, now) in enumerate(pairwise(visible), start=1) if before.is_good and not now.is_good
    ]
    waits = [wait for i in losses if (wait := reacquisition(visible, i)) is not None]
    report: dict[str, Any] = {"losses": len(losses), "reacquisitions": len(waits)}
    return report | ({"reacquisition_images_p50": median(waits)} if waits else {})


def reacquisition(scores: Sequence[Score], first: int) -> int | None:
    """Images until the object is found where it is, 0 if at once; None if it is not found before the end.

    Args:
        scores: Of a film.
        first: The first image in which the object is back.
    """
    return next((i - first for i in range(first, len(scores)) if scores[i].is_good), None)
