"""What says which of all the things in an image is the object: a person, its colour, or its flight."""

from abc import ABC, abstractmethod
from itertools import product

import cv2
import numpy as np

from pixel2catch.perception.background import Foreground
from pixel2catch.perception.color import ColorRange
from pixel2catch.perception.image_track import GAP, Blob, find_blobs
from pixel2catch.perception.segmenter import BoxPrompt, Image, Mask, Prompt

Region = tuple[float, float, float, float]
"""xmin, ymin, xmax, ymax [px]."""

LEAST_SPEED, LARGEST_SPEED = 8.0, 90.0
"""Slowest and fastest motion of a flying thing between two images [px]. Source: ours; a throw begins with 10
or more, and rendered catches move by 61 at most."""

LARGEST_CHANGE = 12.0
"""Largest change of its motion [px]. Source: ours; gravity and approach make up to 10."""

LARGEST_GROWTH = 2.5
"""How many times larger a flying thing may be in one of three images than in another. Source: ours."""


class Prompter(ABC):
    """Looks for the object; asked about one image after the other until it is found, and when it is lost."""

    @abstractmethod
    def look(self, image: Image, ignored: Mask | None = None) -> Prompt | None:
        """Return where the object is, or None where it is not known yet.

        Args:
            image: The newest image.
            ignored: Pixels in which motion means nothing, such as those of the robot; None for no such pixel.
        """

    @abstractmethod
    def reset(self) -> None:
        """Begin a new throw."""


class GivenPrompter(Prompter):
    """A box or a click by a person, best while the object is held still."""

    def __init__(self, prompt: Prompt | None = None) -> None:
        """Begin each throw with the same prompt, such as for an object on a stand, or with none."""
        self._usual = self._next = prompt

    def give(self, prompt: Prompt) -> None:
        """Point the object out in the next image, once."""
        self._next = prompt

    def look(self, image: Image, ignored: Mask | None = None) -> Prompt | None:
        """See `Prompter.look`."""
        prompt, self._next = self._next, None
        return prompt

    def reset(self) -> None:
        """See `Prompter.reset`."""
        self._next = self._usual


class FirstPrompter(Prompter):
    """Several ways to look, in the order of preference: such as a box first, and after a loss motion."""

    def __init__(self, *prompters: Prompter) -> None:
        """Ask these, the first first."""
        self._prompters = prompters

    def look(self, image: Image, ignored: Mask | None = None) -> Prompt | None:
        """See `Prompter.look`; all are asked, because some learn."""
        answers = [prompter.look(image, ignored) for prompter in self._prompters]
        return next((prompt for prompt in answers if prompt is not None), None)

    def reset(self) -> None:
        """Reset all of them."""
        for prompter in self._prompters:
            prompter.reset()


class LaterPrompter(Prompter):
    """Another one, that says nothing before the first throw begins with a reset; it may learn until then."""

    def __init__(self, prompter: Prompter) -> None:
        """Silence this one."""
        self._prompter, self._has_begun = prompter, False

    def look(self, image: Image, ignored: Mask | None = None) -> Prompt | None:
        """See `Prompter.look`."""
        prompt = self._prompter.look(image, ignored)
        return prompt if self._has_begun else None

    def reset(self) -> None:
        """See `Prompter.reset`."""
        self._prompter.reset()
        self._has_begun = True


class ColorPrompter(Prompter):
    """The largest thing of a colour, in a region of interest."""

    def __init__(self, colors: ColorRange, *, region: Region | None = None) -> None:
        """Look for these colours where the object is held: the whole image if no region is given."""
        self._colors, self._region = colors, region

    def look(self, image: Image, ignored: Mask | None = None) -> Prompt | None:
        """See `Prompter.look`."""
        mask = _within(self._colors.mask(image), self._region)
        return next((_box(blob) for blob in find_blobs(mask) if blob.is_plausible), None)

    def reset(self) -> None:
        """Nothing is remembered."""


class MotionPrompter(Prompter):
    """What flies: of an object's size, and moved twice by about the same.

    It looks at the foreground, so it needs some images of the background before. A thrower's arm is longer
    than an object.
    """

    def __init__(self, *, region: Region | None = None) -> None:
        """Look for a flight in a region, the whole image if none is given."""
        self._foreground, self._region = Foreground(), region
        self.reset()

    def look(self, image: Image, ignored: Mask | None = None) -> Prompt | None:
        """See `Prompter.look`."""
        moving, _ = self._foreground.step(image, ignored)
        whole = cv2.morphologyEx(moving.view(np.uint8), cv2.MORPH_CLOSE, GAP) > 0
        newest = [blob for blob in find_blobs(_within(whole, self._region)) if blob.is_plausible]
        oldest, middle = self._before
        self._before = (middle, newest)
        triples = product(newest, middle, oldest)
        return next((_box(now) for now, *before in triples if _flies(now, *before)), None)

    def reset(self) -> None:
        """Forget what moved; what is known of the background stays."""
        self._before: tuple[list[Blob], list[Blob]] = ([], [])


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


def _box(blob: Blob) -> BoxPrompt:
    """The box around a blob."""
    (u, v), half_width, half_height = blob.center, 0.5 * blob.width, 0.5 * blob.height
    return BoxPrompt(box=(u - half_width, v - half_height, u + half_width, v + half_height))
