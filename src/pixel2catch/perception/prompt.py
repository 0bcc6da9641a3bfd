"""What says which of all the things in an image is the object: a person, its colour, or its flight."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from pixel2catch.perception.background import Foreground, ForegroundCfg
from pixel2catch.perception.color import ColorRange
from pixel2catch.perception.image_track import GAP, Blob, FollowCfg, find_blobs, is_plausible
from pixel2catch.perception.segmenter import BoxPrompt, Image, Mask, Prompt

Region = tuple[float, float, float, float]
"""xmin, ymin, xmax, ymax [px]."""

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

    def __init__(
        self, colors: ColorRange, *, region: Region | None = None, follow: FollowCfg | None = None
    ) -> None:
        """Look for a colour.

        Args:
            colors: The object's colours.
            region: Where the object is held; the whole image if absent.
            follow: How large it may be.
        """
        self._colors, self._region, self._follow = colors, region, follow or FollowCfg()

    def look(self, image: Image, ignored: Mask | None = None) -> Prompt | None:
        """See `Prompter.look`."""
        mask = _within(self._colors.mask(image), self._region)
        plausible = (blob for blob in find_blobs(mask).blobs if is_plausible(blob, self._follow))
        return next((_box(blob) for blob in plausible), None)

    def reset(self) -> None:
        """Nothing is remembered."""


@dataclass(frozen=True, kw_only=True)
class FlightCfg:
    """What the motion of a thrown object is, in three successive images.

    Attributes:
        least_speed: Slowest motion between two images [px]. Source: ours; a throw begins with 10 or more.
        largest_speed: Fastest motion [px]. Source: ours; 61 in rendered catches.
        largest_change: Largest change of the motion [px]. Source: ours; gravity and approach make up to 10.
    """

    least_speed: float = 8.0
    largest_speed: float = 90.0
    largest_change: float = 12.0

    def joins(self, now: Blob, before: Blob, oldest: Blob) -> bool:
        """Return whether these can be one flying thing, newest first."""
        if not self.least_speed <= now.distance(before.center) <= self.largest_speed:
            return False
        continued = (2 * before.center[0] - oldest.center[0], 2 * before.center[1] - oldest.center[1])
        areas = (now.area, before.area, oldest.area)
        return now.distance(continued) <= self.largest_change and max(areas) <= LARGEST_GROWTH * min(areas)


class MotionPrompter(Prompter):
    """What flies: of an object's size, and moved twice by about the same.

    It looks at the foreground, so it needs some images of the background before. A thrower's arm is longer
    than an object.
    """

    def __init__(
        self,
        *,
        background: ForegroundCfg | None = None,
        region: Region | None = None,
        flight: FlightCfg | None = None,
        follow: FollowCfg | None = None,
    ) -> None:
        """Look for a flight.

        Args:
            background: How the background is learned.
            region: Where the object may be found; the whole image if absent.
            flight: What a flight is.
            follow: How large the object may be.
        """
        self._foreground = Foreground(background or ForegroundCfg())
        self._region, self._flight, self._follow = region, flight or FlightCfg(), follow or FollowCfg()
        self.reset()

    def look(self, image: Image, ignored: Mask | None = None) -> Prompt | None:
        """See `Prompter.look`."""
        moving, _ = self._foreground.step(image, ignored)
        whole = cv2.morphologyEx(moving.view(np.uint8), cv2.MORPH_CLOSE, GAP) > 0
        blobs = find_blobs(_within(whole, self._region)).blobs
        newest = tuple(blob for blob in blobs if is_plausible(blob, self._follow))
        oldest, middle = self._before
        self._before = (middle, newest)
        triples = product(newest, middle, oldest)
        return next((_box(now) for now, *before in triples if self._flight.joins(now, *before)), None)

    def reset(self) -> None:
        """Forget what moved; what is known of the background stays."""
        self._before: tuple[tuple[Blob, ...], tuple[Blob, ...]] = ((), ())


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
