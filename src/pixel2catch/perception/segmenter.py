"""What finds the object's pixels in a stream of images: the interface, its input and its output."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, UInt8

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.plausibility import USUAL, PlausibilityCfg

Image = UInt8[np.ndarray, "height width 3"]  #: Red, green, blue; upper row first.
Mask = Bool[np.ndarray, "height width"]  #: Which pixels of an image are meant.


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """What an image shows of motion.

    Attributes:
        image: The image, smoothed, in the light of the background.
        difference: How far each pixel is from the background, in its worst channel.
        moving: Which pixels differ from the background.
        unknown: In which pixels that cannot be told, but for the smoothed rim of what is ignored.
        ignored: In which pixels it means nothing, such as those of the robot; None for no such pixel.
        doubt: Why it is less sure than usual; empty if it is not.
    """

    image: Image
    difference: UInt8[np.ndarray, "height width"]
    moving: Mask
    unknown: Mask
    ignored: Mask | None = None
    doubt: str = ""


@dataclass(frozen=True, kw_only=True)
class BoxPrompt:
    """The object is what this box holds: xmin, ymin, xmax, ymax in continuous image coordinates [px]."""

    box: tuple[float, float, float, float]
    is_guess: bool = False  #: Whether only its flight points it out.

    @property
    def center(self) -> tuple[float, float]:
        """Middle of the box [px]."""
        xmin, ymin, xmax, ymax = self.box
        return 0.5 * (xmin + xmax), 0.5 * (ymin + ymax)


@dataclass(frozen=True, kw_only=True)
class PointPrompt:
    """The object is what this point (u, v) lies on, in continuous image coordinates [px]."""

    center: tuple[float, float]


Prompt = BoxPrompt | PointPrompt  #: Which of all the things in an image is the object.


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """What a segmenter makes of one image."""

    mask: Mask | None  #: The object's pixels, not empty; None where the object is not found.
    score: float  #: How sure the segmenter is, larger is surer; the scale is its own.
    source: str = ""  #: Which of several segmenters was believed; empty where there is one.
    doubt: str = ""  #: What speaks against it; empty where nothing does.


NOT_FOUND = Segmentation(mask=None, score=0.0)
"""The object is not in the image, as far as a segmenter without a score of its own can tell."""


class Segmenter(ABC):
    """Follows one object through a stream of images.

    Every image of the stream goes once to `start` or to `track`, in order. All images have the size of the
    first. A segmenter never changes an image or a mask that it was given, and never returns one that it
    changes later.
    """

    uses_motion: ClassVar[bool] = False  #: Whether it must be told what moves in each image.
    plausibility = USUAL  #: What can be the object, for one that chooses among regions.

    def expect(self, plausibility: PlausibilityCfg) -> None:
        """Learn what can be the object, before the first image."""
        self.plausibility = plausibility

    @abstractmethod
    def start(self, image: Image, prompt: Prompt, motion: Motion | None = None) -> Segmentation:
        """Begin to follow what the prompt points at; what was followed before is forgotten.

        Args:
            image: The image that the prompt belongs to.
            prompt: Where the object is.
            motion: What moves in the image; None where `uses_motion` is false.

        Raises:
            PerceptionError: If the image is none, or of another size than those before.
        """

    @abstractmethod
    def track(self, image: Image, motion: Motion | None = None) -> Segmentation:
        """Find the object in the next image, see `start`; not found where nothing was started."""

    def settle(self) -> None:
        """Do what the last answer need not wait for, such as to learn; else the next image does it first."""
        return

    @abstractmethod
    def reset(self) -> None:
        """Forget the object."""


def check_image(image: np.ndarray, width: int, height: int) -> None:
    """Refuse what a camera or a file delivered if it is not an RGB image of this size [px].

    Raises:
        PerceptionError: If shape or dtype are wrong; the message says how they must be.
    """
    if image.dtype == np.uint8 and image.shape == (height, width, 3):
        return
    raise PerceptionError(
        f"the image has shape {tuple(image.shape)} and dtype {image.dtype}; it must be "
        f"({height}, {width}, 3) and uint8, in the order red, green, blue: set the camera's resolution and "
        "encoding (rgb8) accordingly."
    )
