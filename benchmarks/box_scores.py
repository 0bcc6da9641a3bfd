"""How right the boxes of a film are: before the release, in flight, near the hand."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from rendered_throws import LabelledImage

from pixel2catch.perception.extractor import Extraction
from pixel2catch.perception.plausibility import Verdict

NEAR_HAND = 0.25
"""From the palm to the object [m]; what was nearer once is near the hand from then on. Source: ours, the last
two images of a flight."""

LEAST_PIXELS = 6
"""Visible pixels of the object from which it can be found. Source: as the gate's."""

GOOD = 5.0
"""Largest error of an edge that is good enough [px]. Source: the noise of training."""


class Phase(StrEnum):
    """Parts of a throw."""

    HELD = "held"
    FLIGHT = "flight"
    HAND = "near the hand"


@dataclass(frozen=True, kw_only=True)
class Score:
    """What became of one image.

    Attributes:
        phase: Of the throw.
        time: Since the release [s].
        is_visible: Whether there was enough of the object to see.
        is_seen: Whether it was found.
        error: Of the worst edge of the box that the policy gets, be it new or held [px]; no number where the
            object is not visible.
        verdict: What the perception says.
    """

    phase: Phase
    time: float
    is_visible: bool
    is_seen: bool
    error: float
    verdict: Verdict

    @property
    def is_good(self) -> bool:
        """Whether the object was found where it is."""
        return self.is_seen and self.error <= GOOD


def score(shots: Sequence[LabelledImage], extractions: Sequence[Extraction]) -> list[Score]:
    """Compare what was seen in the images of a film with the truth.

    Args:
        shots: The images of the episode.
        extractions: What was made of each.
    """
    scores, is_near = [], False
    for shot, seen in zip(shots, extractions, strict=True):
        is_near = is_near or shot.palm_distance < NEAR_HAND
        is_visible = shot.num_pixels >= LEAST_PIXELS
        error = float((seen.box - shot.box).abs().max()) if is_visible else float("nan")
        phase = Phase.HAND if is_near else Phase.FLIGHT if shot.time > 0.0 else Phase.HELD
        is_seen = seen.verdict is Verdict.SEEN
        scores.append(
            Score(
                phase=phase,
                time=shot.time,
                is_visible=is_visible,
                is_seen=is_seen,
                error=error,
                verdict=seen.verdict,
            )
        )
    return scores


def summary(scores: Iterable[Score]) -> dict[str, dict[str, Any]]:
    """Rates and errors [px] in every phase, over the images in which the object is visible."""
    rows = list(scores)
    return {str(phase): _summary([each for each in rows if each.phase is phase]) for phase in Phase}


def _summary(rows: list[Score]) -> dict[str, Any]:
    """Rates and errors of one phase."""
    visible = [each for each in rows if each.is_visible]
    errors = [each.error for each in visible if each.is_seen]
    delivered = [each.error for each in visible]
    report: dict[str, Any] = {"images": len(visible), "hidden": len(rows) - len(visible)}
    report["seen_though_hidden"] = sum(each.is_seen for each in rows if not each.is_visible)
    if not visible:
        return report
    report["detected"] = len(errors) / len(visible)
    report["within_5px"] = sum(each.is_good for each in visible) / len(visible)
    names = ("p50", "p95")
    for name, values in (("error", errors), ("delivered_error", delivered)):
        if values:
            quantiles = np.percentile(values, (50, 95)).tolist()
            report |= {f"{name}_{p}": value for p, value in zip(names, quantiles, strict=True)}
    return report


def reacquisition(scores: Sequence[Score], first: int) -> int | None:
    """Images until the object is found where it is, 0 if at once; None if it is not found before the end.

    Args:
        scores: Of a film.
        first: The first image in which the object is back.
    """
    return next((i - first for i in range(first, len(scores)) if scores[i].is_good), None)
