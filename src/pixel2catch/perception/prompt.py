"""What says which of all the things in an image is the object: a person, its colour, or its flight."""

from itertools import product

import numpy as np

from pixel2catch.perception.color import ColorRange
from pixel2catch.perception.foreground import Weakness, closed
from pixel2catch.perception.image_track import LARGEST_CHANGE, Blob, find_blobs
from pixel2catch.perception.plausibility import USUAL, PlausibilityCfg
from pixel2catch.perception.segmenter import BoxPrompt, Image, Mask, Motion, Prompt

Region = tuple[float, float, float, float]
"""xmin, ymin, xmax, ymax [px]."""

LEAST_SPEED, LARGEST_SPEED = 8.0, 90.0
"""Slowest and fastest motion of a flying thing between two images [px]. Source: ours; a throw begins with 10
or more, and rendered catches move by 61 at most."""

LARGEST_GROWTH = 2.5
"""How many times larger a flying thing may be in one of three images than in another. Source: ours."""


class Prompter:
    """Looks for the object; asked about one image after the other until it is found, and when it is lost.

    Preferred is a box or a click by a person, best while the object is held still; then the largest thing of
    its colour; then what flies: of an object's size, and moved twice by about the same. Flights are found
    once the background was seen for a second.
    """

    def __init__(
        self,
        prompt: Prompt | None = None,
        *,
        colors: ColorRange | None = None,
        region: Region | None = None,
    ) -> None:
        """Begin before the first throw.

        Args:
            prompt: Where the object is when a throw begins, such as on a stand; None if a person says so.
            colors: The object's colours, if they are known.
            region: Where it may be found by colour or flight; the whole image if absent.
        """
        self._usual, self._plausibility = prompt, USUAL
        self._colors, self._region = colors, region
        self.reset()

    def expect(self, plausibility: PlausibilityCfg) -> None:
        """Learn what can be the object, before the first image."""
        self._plausibility = plausibility

    def reset(self) -> None:
        """Begin a new throw; what is known of the background stays."""
        self._given = self._usual
        self._before: tuple[list[Blob], list[Blob]] = ([], [])

    def give(self, prompt: Prompt) -> None:
        """Point the object out in the next image, once."""
        self._given = prompt

    def look(self, image: Image, motion: Motion | None = None) -> Prompt | None:
        """Return where the object is, or None where it is not known yet.

        Args:
            image: The newest image.
            motion: What moves in it; None if nothing does.
        """
        given, self._given = self._given, None
        flying = self._flying(motion)  # looks at every image, because it remembers two
        return given or self._colored(image) or flying

    def _colored(self, image: Image) -> BoxPrompt | None:
        """The largest thing of the object's colours."""
        if self._colors is None:
            return None
        blobs = find_blobs(_within(self._colors.mask(image), self._region))
        sized = (blob for blob in blobs if blob.is_plausible(self._plausibility))
        return next((BoxPrompt(box=blob.box) for blob in sized), None)

    def _flying(self, motion: Motion | None) -> BoxPrompt | None:
        """What flew in the last three images; a thrower's arm is longer than an object."""
        if motion is None or motion.doubt == Weakness.FEW_IMAGES:
            return None
        whole = _within(closed(motion.moving), self._region)
        newest = [blob for blob in find_blobs(whole) if blob.is_plausible(self._plausibility)]
        oldest, middle = self._before
        self._before = (middle, newest)
        triples = product(newest, middle, oldest)
        flying = (now for now, *before in triples if _flies(now, *before))
        return next((BoxPrompt(box=blob.box, is_guess=True) for blob in flying), None)


def _flies(now: Blob, before: Blob, oldest: Blob) -> bool:
    """Whether these can be one flying thing in three successive images, newest first."""
    if not LEAST_SPEED <= now.distance(before.center) <= LARGEST_SPEED:
        return False
    continued = (2 * before.center[0] - oldest.center[0], 2 * before.center[1] - oldest.center[1])
    areas = (now.area, before.area, oldest.area)
    return now.distance(continued) <= LARGEST_CHANGE and max(areas) <= LARGEST_GROWTH * min(areas)


def _within(mask: Mask, region: Region | None) -> Mask:
    """The part of a mask in a region."""
    if region is None:
        return mask
    xmin, ymin, xmax, ymax = (max(round(edge), 0) for edge in region)
    part = np.zeros_like(mask)
    part[ymin:ymax, xmin:xmax] = mask[ymin:ymax, xmin:xmax]
    return part
