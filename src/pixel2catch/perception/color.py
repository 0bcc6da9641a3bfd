"""The object by its colour: a range of hue, saturation and value."""

from dataclasses import dataclass

import cv2
import numpy as np

from pixel2catch.errors import PerceptionError
from pixel2catch.perception.blobs import Course, FollowCfg, find_blobs
from pixel2catch.perception.foreground import SPECK
from pixel2catch.perception.segmenter import NOT_FOUND, Image, Mask, Prompt, Segmentation, Segmenter


@dataclass(frozen=True, kw_only=True)
class ColorRange:
    """Colours from a first to a last hue, saturation and value.

    Attributes:
        hue: First and last hue [degrees]: red 0, green 120, blue 240; (340, 20) is the reds about 0.
        saturation: Smallest and largest share of colour in [0, 1]; grey is 0.
        value: Smallest and largest brightness in [0, 1].
    """

    hue: tuple[float, float]
    saturation: tuple[float, float] = (0.4, 1.0)
    value: tuple[float, float] = (0.2, 1.0)

    def __post_init__(self) -> None:
        """Refuse a range that no colour is in."""
        if not all(0.0 <= bound <= 360.0 for bound in self.hue):
            raise PerceptionError(f"hue is {self.hue}; both ends must be in [0, 360] degrees.")
        for name in ("saturation", "value"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 1.0:
                raise PerceptionError(f"{name} is ({low:g}, {high:g}); it must be ordered and in [0, 1].")

    def mask(self, image: Image) -> Mask:
        """Which pixels have such a colour, without single specks."""
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
        pixels = np.zeros(image.shape[:2], dtype=bool)
        for first, last in self._hue_intervals():
            lower = np.array((first / 2, 255 * self.saturation[0], 255 * self.value[0]))
            upper = np.array((last / 2, 255 * self.saturation[1], 255 * self.value[1]))
            pixels |= cv2.inRange(hsv, lower, upper) > 0
        return cv2.morphologyEx(pixels.view(np.uint8), cv2.MORPH_OPEN, SPECK) > 0

    def _hue_intervals(self) -> tuple[tuple[float, float], ...]:
        """The hues as intervals that do not cross red [degrees]."""
        first, last = self.hue
        return ((first, last),) if first <= last else ((first, 360.0), (0.0, last))


class ColorThreshold(Segmenter):
    """Follows the region of the object's colour that is nearest to where the object should be.

    Robust where the object is the only thing of its colour. It needs no background and sees the object in the
    hand, too.
    """

    def __init__(self, colors: ColorRange, follow: FollowCfg | None = None) -> None:
        """Follow a colour.

        Args:
            colors: The object's colours.
            follow: Which of several regions is taken.
        """
        self._colors, self._follow = colors, follow or FollowCfg()
        self._course: Course | None = None

    def start(self, image: Image, prompt: Prompt, ignored: Mask | None = None) -> Segmentation:
        """Begin at the prompt: see `Segmenter.start`."""
        self._course = Course(center=prompt.center)
        return self.track(image, ignored)

    def track(self, image: Image, ignored: Mask | None = None) -> Segmentation:
        """See `Segmenter.track`; colour needs no motion, so nothing is ignored."""
        if self._course is None:
            return NOT_FOUND
        found = find_blobs(self._colors.mask(image))
        blob = self._course.next_blob(found, self._follow)
        self._course, segmentation = self._course.advanced(found, blob)
        return segmentation

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._course = None
