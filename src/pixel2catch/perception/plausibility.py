"""Which boxes can be the object's: a segmenter that lost it may return anything."""

from dataclasses import dataclass
from enum import StrEnum
from math import hypot

from jaxtyping import Float
from torch import Tensor

from pixel2catch.scene.constants import CameraSpec


class Verdict(StrEnum):
    """What became of one control step's image; all but `SEEN` leave the box as it was."""

    SEEN = "seen"
    NO_IMAGE = "no image"
    REPEATED = "repeated image"
    BAD_IMAGE = "bad image"
    NO_PROMPT = "no prompt"
    NOT_FOUND = "not found"
    FAILED = "segmenter failed"
    TOO_SMALL = "too small"
    TOO_LARGE = "too large"
    JUMP = "jump"
    BORDER = "border"


@dataclass(frozen=True, kw_only=True)
class PlausibilityCfg:
    """Limits of the plausible. Source: ours, from 1,500 rendered images of 16 catches."""

    least_area: int = 6  #: Fewest pixels.
    largest_share: float = 0.02  #: Largest share of the image. Source: ours; 0.5 % at most in those images.
    largest_jump: float = 90.0  #: Of the middle of the box in a control step [px]; 61 in those images.
    largest_sides: int = 1  #: Most sides of the image that the box touches; an object passes one at a time.


def judge(
    cfg: PlausibilityCfg,
    camera: CameraSpec,
    box: Float[Tensor, "1 4"],
    area: int,
    before: Float[Tensor, "1 4"] | None = None,
    steps: float = 1.0,
) -> Verdict:
    """Return whether a box [px] around so many pixels can be the object's, or why not.

    The box before is the one last accepted [px], so many control steps ago; None where the object was just
    pointed out.
    """
    xmin, ymin, xmax, ymax = box[0].tolist()
    if area < cfg.least_area:
        return Verdict.TOO_SMALL
    if (xmax - xmin) * (ymax - ymin) > cfg.largest_share * camera.width * camera.height:
        return Verdict.TOO_LARGE
    if (xmin <= 0) + (ymin <= 0) + (xmax >= camera.width) + (ymax >= camera.height) > cfg.largest_sides:
        return Verdict.BORDER
    if before is not None:
        old_xmin, old_ymin, old_xmax, old_ymax = before[0].tolist()
        jump = 0.5 * hypot(xmin + xmax - old_xmin - old_xmax, ymin + ymax - old_ymin - old_ymax)
        if jump > cfg.largest_jump * max(steps, 1.0):
            return Verdict.JUMP
    return Verdict.SEEN
