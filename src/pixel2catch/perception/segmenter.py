"""What finds the object's pixels in a stream of images: the interface, its data, and a colour threshold."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from math import hypot, sqrt
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pixel2catch.camera.image import Edges, Mask, Pixels
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.regions import USUAL, Blob, PlausibilityCfg, find_blobs, opened, regions


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageMotion:
    """Where an image differs from the background."""

    image: Pixels  #: The image, smoothed, with the brightness of the background.
    background: Pixels  #: What it shows without moving things, until the next image.
    difference: UInt8[np.ndarray, "height width"]  #: From the background, in the channel where it is largest.
    moving: Mask  #: Pixels that differ from the background.
    unknown: Mask  #: Pixels without a known background, except the smoothed rim of `ignored`.
    ignored: Mask | None = None  #: Pixels whose motion has no meaning, such as those of the robot.
    doubt: str = ""  #: Why it is less reliable than usual; empty without a reason.

    @cached_property
    def things(self) -> list[Blob]:
        """The regions that move."""
        return regions(self.moving)


@dataclass(frozen=True, kw_only=True)
class BoxPrompt:
    """Which of the things in an image is the object: the one that fills this box."""

    box: Edges
    is_guess: bool = False  #: Whether it was found by its flight alone.

    @property
    def center(self) -> tuple[float, float]:
        """Middle of the box [px]."""
        xmin, ymin, xmax, ymax = self.box
        return 0.5 * (xmin + xmax), 0.5 * (ymin + ymax)


@dataclass(frozen=True, kw_only=True, eq=False)
class Segmentation:
    """The pixels of the object in one image. It stays inside perception: the tracker makes a `Box` of it."""

    mask: Mask | None  #: The object's pixels, not empty; None where the object is not found.
    score: float  #: Larger is more certain; each segmenter has its own scale.


Motion = ImageMotion | None
Prompt = BoxPrompt | None
NOT_FOUND = Segmentation(mask=None, score=0.0)
"""Result of a segmenter without a score of its own where it does not find the object."""


class Segmenter(ABC):
    """Follows one object through a stream of images of one size; it changes neither inputs nor results."""

    uses_motion: ClassVar[bool] = False  #: Whether it needs an `ImageMotion` for every image.
    limits = USUAL  #: What can be the object. Set it before the first image.

    @abstractmethod
    def find(
        self, image: Pixels, motion: Motion = None, prompt: Prompt = None, interval: float = 1.0
    ) -> Segmentation:
        """Find the object in the next image; it is not found before the first prompt.

        Args:
            image: The next image of the stream.
            motion: What moves in it; None where `uses_motion` is false.
            prompt: Where the object is in it; the object before is discarded. None follows that one.
            interval: Time since the image before [control steps].

        Raises:
            PerceptionError: The array is no image, or its size differs from the images before.
        """

    def settle(self) -> None:
        """Do the work that the last result did not need, such as learning; else the next image does it."""
        return

    @abstractmethod
    def reset(self) -> None:
        """Discard the object."""


def check_image(image: np.ndarray, width: int, height: int) -> None:
    """Require an RGB image of this size [px].

    Raises:
        PerceptionError: Shape or dtype differ.
    """
    if image.dtype == np.uint8 and image.shape == (height, width, 3):
        return
    raise PerceptionError(
        f"the image has shape {tuple(image.shape)} and dtype {image.dtype}; it must be "
        f"({height}, {width}, 3) and uint8, in the order red, green, blue: set the camera's resolution and "
        "encoding (rgb8) accordingly."
    )


REACH, REACH_GROWTH, LARGEST_REACH = 45.0, 30.0, 150.0
"""Largest distance of the object from its way to the expected place, its growth with every control step
without the object, and its limit [px]. Source: ours; a release moves it by up to 30 px a step."""

LARGEST_CHANGE = 12.0  #: Of a flight's motion in a control step [px]. Source: ours; gravity makes up to 10.
LONGEST_STEP = 20.0  #: Largest motion in a control step with which another thing is known [px]. Source: ours.
LARGEST_GROWTH = 2.0  #: Largest area of the object over before. Source: ours.
LONGEST_COAST = 3.0  #: Control steps for which an unseen object keeps its velocity. Source: ours.


@dataclass(frozen=True, kw_only=True)
class ImageTrack:
    """Last place and motion of the object in the image, with constant velocity; times in control steps."""

    center: tuple[float, float]  #: Middle of its last box [px].
    velocity: tuple[float, float] = (0.0, 0.0)  #: When it was last seen [px per control step].
    span: float = 1.0  #: Time between the two boxes that gave the velocity.
    interval: float = 1.0  #: Time between the newest two images.
    age: float = 0.0  #: Time since the last box.
    num_seen: int = 0  #: Images in which it was seen; the velocity is known from two on.
    others: tuple[tuple[float, float], ...] = ()  #: Middles of the other things in the last image [px].
    is_alone: bool = False  #: Whether it was a moving thing of its own when it was last seen.
    cover: Edges | None = None  #: Box of the larger moving thing that has hidden it since [px].
    limits: PlausibilityCfg = USUAL  #: What can be the object.

    def after(self, interval: float) -> "ImageTrack":
        """Return the track at the next image, so long after the one before."""
        return replace(self, interval=interval, age=self.age + interval)

    @property
    def expected(self) -> tuple[float, float]:
        """Expected place in the newest image [px]. It stops `LONGEST_COAST` after the last box."""
        time = min(self.age, LONGEST_COAST)
        return self.center[0] + time * self.velocity[0], self.center[1] + time * self.velocity[1]

    def behind(self, things: Iterable[Blob], area: float) -> "ImageTrack":
        """Return the track, with the moving thing that hides an object of this area [px²], if one does.

        An object that was a thing of its own is hidden by one that is too large to be it and covers a part
        of its expected place. It reappears beside that thing.
        """
        if not self.is_alone:
            return self
        place = _grown((*self.expected, *self.expected), 0.5 * sqrt(area))
        large = (each for each in things if each.area > LARGEST_GROWTH * area)
        return replace(self, cover=next((each.box for each in large if each.meets(place)), self.cover))

    def advanced(
        self, blobs: list[Blob], blob: Blob | None, things: Iterable[Blob] = ()
    ) -> tuple["ImageTrack", Segmentation]:
        """Return the track with the newest image, in which the object is one of the regions, and its pixels.

        Without the object only the regions that continue another thing are other things. The score is the
        region's share of its box. An object of about the size of a moving thing is a thing of its own.
        """
        if blob is None:
            known = self._gaps(blobs).min(axis=1, initial=np.inf) < np.inf
            return replace(self, others=tuple(each.center for each in compress(blobs, known))), NOT_FOUND
        (u, v), span = blob.center, self.age or 1.0
        fresh = min(span, 1.0) if self.num_seen > 1 else float(self.num_seen)  # fast images are averaged
        moved = (u - self.center[0]) / span, (v - self.center[1]) / span
        du, dv = (old + fresh * (new - old) for old, new in zip(self.velocity, moved, strict=True))
        is_alone = any(each.area <= LARGEST_GROWTH * blob.area and each.meets(blob.box) for each in things)
        track = ImageTrack(
            center=blob.center,
            velocity=(du, dv),
            span=span,
            num_seen=self.num_seen + 1,
            others=tuple(each.center for each in blobs if each is not blob),
            is_alone=is_alone,
            limits=self.limits,
        )
        score = blob.area / (blob.width * blob.height)
        return track, Segmentation(mask=blob.mask(), score=score)

    @property
    def reach(self) -> float:
        """Largest distance of the object from its last place, wherever it was thrown or bounced [px]."""
        return self.limits.largest_jump * min(max(self.age, 1.0), LONGEST_COAST)

    @property
    def nearness(self) -> float:
        """Largest distance from its way to the expected place without a bounce [px]."""
        return min(REACH + REACH_GROWTH * max(self.age - 1.0, 0.0), LARGEST_REACH)

    def candidates(self, blobs: list[Blob]) -> list[Blob]:
        """Return the regions that can be the object, those on its way first, then the nearest to its place.

        They have an object's size and are where it can be. Regions that continue another thing of the last
        image are left out.
        """
        sized = (blob for blob in compress(blobs, ~self._are_others(blobs)) if blob.is_plausible(self.limits))
        near = (blob for blob in sized if blob.distance(self.center) <= self.reach)
        if self.cover is not None:  # it reappears beside the thing that hides it
            beside = _grown(self.cover, REACH * max(self.interval, 1.0))
            near = (blob for blob in near if blob.meets(beside))
        return sorted(near, key=lambda blob: (not self.passes(blob), blob.distance(self.expected)))

    def leads_to(self, blob: Blob) -> bool:
        """Return whether a region is at the expected place, within what gravity and approach change."""
        return self.num_seen > 1 and blob.distance(self.expected) <= largest_change(self.age, self.span)

    def passes(self, blob: Blob) -> bool:
        """Return whether a region is on the way to the expected place, where a hand may stop it."""
        (u, v), (end_u, end_v) = self.center, self.expected
        du, dv = end_u - u, end_v - v
        at_u, at_v = blob.center
        share = min(max((du * (at_u - u) + dv * (at_v - v)) / max(du * du + dv * dv, 1.0), 0.0), 1.0)
        return hypot(at_u - u - share * du, at_v - v - share * dv) <= self.nearness

    def _are_others(self, blobs: list[Blob]) -> Bool[np.ndarray, " num_blobs"]:
        """Whether each region is the nearest one to another thing's last place, and not at the object's."""
        gaps, boxes = self._gaps(blobs), np.array([blob.box for blob in blobs]).reshape(-1, 4)
        reach = np.array([blob.distance(self.expected) for blob in blobs])[:, None]
        is_apart = ((boxes[:, :2] > self.expected) | (boxes[:, 2:] < self.expected)).any(axis=1)
        return is_apart & ((gaps < reach) & (gaps <= gaps.min(axis=0, initial=np.inf))).any(axis=1)

    def _gaps(self, blobs: list[Blob]) -> Float[np.ndarray, "num_blobs num_others"]:
        """Distances of regions from the last places of the other things [px]; infinite beyond a step."""
        centers = np.array([blob.center for blob in blobs]).reshape(-1, 1, 2)
        gaps = np.linalg.norm(centers - np.array(self.others).reshape(1, -1, 2), axis=2)
        return np.where(gaps <= LONGEST_STEP * max(self.interval, 1.0), gaps, np.inf)


def largest_change(interval: float, before: float) -> float:
    """Return how far gravity and approach move a flight from where two images lead it in a third one [px]."""
    return LARGEST_CHANGE * max(0.5 * interval * (interval + before), 1.0)


def _grown(box: Edges, rim: float) -> Edges:
    left, top, right, bottom = box
    return left - rim, top - rim, right + rim, bottom + rim


LEAST_SATURATION, LEAST_VALUE = 0.4, 0.2  #: Of a colour, in [0, 1]; less is grey or dark. Source: ours.


@dataclass(frozen=True, kw_only=True)
class ColorRange:
    """A range of hue, without grey and dark colours."""

    hue: tuple[float, float]  #: First and last [degrees]: red 0, green 120, blue 240; (340, 20) is reds.

    def mask(self, image: Pixels) -> Mask:
        """Return the pixels with such a colour, without specks."""
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
        pixels = np.zeros(image.shape[:2], dtype=bool)
        start, end = self.hue
        for first, last in [(start, end)] if start <= end else [(start, 360.0), (0.0, end)]:
            lower = np.array((first / 2, 255 * LEAST_SATURATION, 255 * LEAST_VALUE))
            pixels |= cv2.inRange(hsv, lower, np.array((last / 2, 255.0, 255.0))) > 0
        return opened(pixels)


class ColorThreshold(Segmenter):
    """Follows the region of the object's colour that is nearest to the object's expected place.

    It suits objects whose colour nothing else has. It needs no background, and finds the object in the hand.
    """

    def __init__(self, colors: ColorRange) -> None:
        self._colors = colors
        self._track: ImageTrack | None = None

    def find(
        self, image: Pixels, motion: Motion = None, prompt: Prompt = None, interval: float = 1.0
    ) -> Segmentation:
        """See `Segmenter.find`."""
        if prompt is not None:
            self._track, interval = ImageTrack(center=prompt.center, limits=self.limits), 0.0
        if self._track is None:
            return NOT_FOUND
        track, blobs = self._track.after(interval), find_blobs(self._colors.mask(image))
        found = next(iter(track.candidates(blobs)), None)
        self._track, segmentation = track.advanced(blobs, found)
        return segmentation

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._track = None
