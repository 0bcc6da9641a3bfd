"""The first two carriers from camera to robot: what the camera delivers, and what perception finds in it."""

from dataclasses import dataclass
from enum import StrEnum
from math import inf

import numpy as np
from jaxtyping import Bool, UInt8

Pixels = UInt8[np.ndarray, "height width 3"]  #: Red, green, blue; upper row first.
Mask = Bool[np.ndarray, "height width"]  #: Marks some pixels of an image.
Edges = tuple[float, float, float, float]  #: xmin, ymin, xmax, ymax in continuous image coordinates [px].


class Verdict(StrEnum):
    """What perception found in an image. Only `SEEN` gives a new box; the others keep the last one."""

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """One image of the camera. The receiver checks its size and type."""

    pixels: np.ndarray  #: Red, green, blue; upper row first. It may be read-only.
    stamp: float  #: When it was taken [s].
    joint_pos: np.ndarray | None = None  #: The robot's at that time, in joint order [rad]; None if unknown.
    encoding: str = ""  #: How the camera's message stored it, such as rgb8; empty without a message.
    readout_time: float = 0.0  #: Time from its first row to its last, the stamp being of the middle one [s].


@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """What perception found in one image, and the newest box of the object."""

    verdict: Verdict  #: What was found in this image.
    stamp: float = -inf  #: When this image was taken [s]; minus infinity without an image.
    #: Newest box of the object in this throw [px], of this image or of an earlier one; zeros before the
    #: first.
    edges: Edges = (0.0, 0.0, 0.0, 0.0)
    is_valid: bool = False  #: Whether the object was seen in this throw.
    age: float = inf  #: Time since the image of `edges` [s]; infinite before the first.
    #: Whether a new box is too far from the last one to be the same flight: policies start a new track.
    is_elsewhere: bool = False
    score: float = 0.0  #: Score that the segmenter gives this image, on its own scale; for the log.
    mask: Mask | None = None  #: Pixels of the object where it was seen; for pictures.
    doubt: str = ""  #: Why the result is less reliable than usual; empty without a reason.
    message: str = ""  #: What was wrong with an image that could not be used.
