"""Which boxes can be the object's: a segmenter that lost it may return anything."""

from dataclasses import dataclass
from enum import StrEnum
from math import hypot

from jaxtyping import Float
from torch import Tensor

from pixel2catch.scene.constants import OBJECT_RADIUS, CameraSpec


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
    """Limits of the plausible. Source: ours, from 1,500 rendered images of 16 catches.

    A flight of the task moves a box by 70 px in a control step at most, one of a person by 77 in 999 of 1,000
    steps, and lets its sides grow by 5 px. What the robot had hidden may appear at once: up to 33 px in 24
    rendered throws.
    """

    least_area: int = 6  #: Fewest pixels.
    largest_share: float = 0.02  #: Largest share of the image. Source: ours; 0.5 % at most in those images.
    #: Longest side of a region of an image [px]. Source: ours; 49 in those images.
    largest_side: float = 100.0
    largest_jump: float = 90.0  #: Of the middle of the box in a control step [px]; 61 in those images.
    largest_growth: float = 50.0  #: Of a side of the box in a control step [px].
    largest_sides: int = 1  #: Most sides of the image that the box touches; an object passes one at a time.

    @classmethod
    def up_to(cls, radius: float) -> "PlausibilityCfg":
        """Limits where objects may be larger than the paper's: up to a ball of this radius [m]."""
        usual, scale = cls(), max(radius / OBJECT_RADIUS, 1.0)
        return cls(
            largest_share=scale**2 * usual.largest_share,
            largest_side=scale * usual.largest_side,
            largest_growth=scale * usual.largest_growth,
        )


USUAL = PlausibilityCfg()  #: Limits for the paper's objects.


def judge(
    cfg: PlausibilityCfg,
    camera: CameraSpec,
    box: Float[Tensor, "1 4"],
    area: int,
) -> Verdict:
    """Return whether a box [px] around so many pixels can be the object's, or why not."""
    xmin, ymin, xmax, ymax = box[0].tolist()
    if area < cfg.least_area:
        return Verdict.TOO_SMALL
    if (xmax - xmin) * (ymax - ymin) > cfg.largest_share * camera.width * camera.height:
        return Verdict.TOO_LARGE
    if (xmin <= 0) + (ymin <= 0) + (xmax >= camera.width) + (ymax >= camera.height) > cfg.largest_sides:
        return Verdict.BORDER
    return Verdict.SEEN


def is_jump(
    cfg: PlausibilityCfg, box: Float[Tensor, "1 4"], before: Float[Tensor, "1 4"], steps: float
) -> bool:
    """Whether a box [px] moved or grew as no thrown object's does since the one so many control steps before.

    It may shrink as it likes: what is hidden is smaller.
    """
    xmin, ymin, xmax, ymax = (box - before)[0].tolist()
    steps = max(steps, 1.0)
    moved, grown = 0.5 * hypot(xmin + xmax, ymin + ymax), max(xmax - xmin, ymax - ymin)
    return moved > cfg.largest_jump * steps or grown > cfg.largest_growth * steps
