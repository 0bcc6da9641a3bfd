"""The object by its motion and its colours: what differs from a learned background where it should be."""

from dataclasses import dataclass
from math import hypot, inf, isinf

import cv2
import numpy as np
from jaxtyping import UInt8

from pixel2catch.perception.color import Appearance
from pixel2catch.perception.image_track import GAP, REACH, SPECK, Blob, ImageTrack, find_blobs
from pixel2catch.perception.segmenter import (
    NOT_FOUND,
    BoxPrompt,
    Image,
    Mask,
    Prompt,
    Segmentation,
    Segmenter,
)

FOREGROUND, SHADOW = 255, 127
"""What OpenCV calls the foreground, and what is the background, but darker."""

MEMORY = 300
"""Images that the background is made of. Source: ours: 10 s at 30 Hz."""

THRESHOLD = 16.0
"""Squared distance of a pixel from the background, in variances, from which it differs. Source: OpenCV."""

LEARNING_IMAGES = 30
"""Images that a pixel must have been seen in without the robot before its changes mean anything: a tenth of
the memory, after which OpenCV takes something new for background."""

INNER = 0.8
"""Share of the width and height of a prompted box in which the object's colours are learned. Source: ours."""

LARGEST_GROWTH, LEAST_SHARE = 2.0, 0.5
"""How many times larger or smaller than before the object may be; where the robot may hide a part of it, any
times smaller. Source: ours."""

LEAST_KNOWN = 0.2
"""Share of a region that has the object's colours if the rest of it is an unseen side. Source: ours."""

AREA_MEMORY = 0.7
"""Weight of what the object's area was before, in every image. Source: ours."""

NEAR = 10.0
"""How far from the object things that stand still have colours that it could be confused with [px].

Source: ours; what is further off and does not move does not touch it."""

THINNING = 2
"""Of what is ignored, every second pixel of every second row is learned."""

RIM = 4  #: Pixels about a part of an image on which it depends what is moving in it.

LEAST_SPEED, NUM_FRESH = 3.0, LEARNING_IMAGES // 3
"""Speed from which the object moves [px an image], and for how many images after that it is no background
yet, so that what differs in nothing from the background is not the object. Source: ours."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """What an image shows of motion.

    Attributes:
        moving: Which pixels differ from the background.
        unknown: In which pixels that cannot be told.
        classes: What OpenCV says of each pixel.
    """

    moving: Mask
    unknown: Mask
    classes: UInt8[np.ndarray, "height width"]

    def changed(self, window: tuple[slice, slice]) -> Mask:
        """Which pixels of a part of the image differ, are only darker, or are near to such ones, or unknown.

        Darker is what is in a shadow, or of a thing of the same colour.
        """
        rows, columns = (slice(max(each.start - RIM, 0), each.stop + RIM) for each in window)
        around = rows, columns
        darker = _opened(self.classes[around] == SHADOW) & ~self.unknown[around]
        grown = _grown(self.moving[around] | darker, GAP) | self.unknown[around]
        top, left = window[0].start - rows.start, window[1].start - columns.start
        return grown[top:, left:][: window[0].stop - window[0].start, : window[1].stop - window[1].start]


class Foreground:
    """Which pixels differ from the background, in a stream of images.

    Where pixels are ignored the background is not learned: the robot that waits for a throw is not taken for
    background, and neither is what it uncovers taken for an object.
    """

    def __init__(self, learning_images: int = LEARNING_IMAGES) -> None:
        """Know no background, and say nothing of a pixel before so many images of it."""
        self._learning_images = learning_images
        self._model = cv2.createBackgroundSubtractorMOG2(MEMORY, THRESHOLD, detectShadows=True)
        self._scene = np.empty((0, 0, 3), dtype=np.uint8)
        self._num_seen = np.empty((0, 0), dtype=np.uint8)

    def step(self, image: Image, ignored: Mask | None) -> Motion:
        """Learn the next image, but for pixels that do not belong to the scene; None for no such pixel."""
        if self._scene.shape != image.shape:
            self._scene = image.copy()
            self._num_seen = np.zeros(image.shape[:2], dtype=np.uint8)
        counted = np.ones_like(self._num_seen) if ignored is None else (~ignored).view(np.uint8)
        cv2.copyTo(image, counted, self._scene)
        cv2.add(self._num_seen, counted, self._num_seen)
        classes = self._model.apply(self._scene)
        known = counted.view(bool) & (self._num_seen >= self._learning_images)
        return Motion(moving=_opened(classes == FOREGROUND) & known, unknown=~known, classes=classes)


class BackgroundSubtraction(Segmenter):
    """Follows what has the object's colours, or moves, near to where the object should be; needs no weights.

    The camera must not move. The colours (`Appearance`) are learned from the prompt and while the object
    flies: they part it from an arm that moves beside it, and show it where motion says nothing, at the robot
    and while it is held still. An object without colours of its own is followed by its motion alone.
    """

    def __init__(self) -> None:
        """Know neither background nor object."""
        self._foreground = Foreground()
        self._track: ImageTrack | None = None
        self._appearance, self._area, self._num_still = Appearance(), inf, inf

    def start(self, image: Image, prompt: Prompt, ignored: Mask | None = None) -> Segmentation:
        """Begin at the prompt, whose colours are learned if it is a box: see `Segmenter.start`."""
        self._track, self._appearance = ImageTrack(center=prompt.center), Appearance()
        self._area = self._num_still = inf
        return self._follow(image, ignored, prompt)

    def track(self, image: Image, ignored: Mask | None = None) -> Segmentation:
        """See `Segmenter.track`."""
        return self._follow(image, ignored, None)

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._track = None

    def _follow(self, image: Image, ignored: Mask | None, prompt: Prompt | None) -> Segmentation:
        """Find the object in the next image, in which it is where a prompt says, if there is one."""
        motion = self._foreground.step(image, ignored)
        if self._track is None:
            return NOT_FOUND
        if isinstance(prompt, BoxPrompt):
            self._learn(image, *_prompted(prompt.box, image), motion, ignored)
        blobs, blob = self._object(image, motion, self._track)
        self._track, segmentation = self._track.advanced(blobs, blob)
        mask, is_first = segmentation.mask, isinf(self._area)
        is_moving = blob is not None and not is_first and hypot(*self._track.velocity) >= LEAST_SPEED
        self._num_still = 0 if is_moving else self._num_still + 1
        if blob is not None and mask is not None and not _overlap(mask, motion.unknown):
            self._area = blob.area if is_first else AREA_MEMORY * self._area + (1 - AREA_MEMORY) * blob.area
            self._learn(image, mask, _grown(mask, GAP), motion, ignored)
        return segmentation

    def _object(self, image: Image, motion: Motion, track: ImageTrack) -> tuple[list[Blob], Blob | None]:
        """The region of the object's colours with its new sides, else of less, else whatever moves.

        Returns:
            The regions that were looked at, and which of them is the object; None if none is.
        """
        alike, whole = self._resembling(image, motion, track)
        for mask in (whole, alike, alike & (motion.moving | motion.unknown), motion.moving):
            blobs = _regions(mask)
            for blob in track.candidates(blobs):
                if self._fits(blob, motion.unknown):
                    return blobs, blob
        return _regions(alike), None

    @property
    def _is_fresh(self) -> bool:
        """Whether the object moved so lately that it is no background yet."""
        return self._num_still < NUM_FRESH

    def _fits(self, blob: Blob, unknown: Mask) -> bool:
        """Whether a region has the object's size, or less where the robot may hide a part of it."""
        if isinf(self._area):
            return True
        is_large = blob.area >= LEAST_SHARE * self._area
        return blob.area <= LARGEST_GROWTH * self._area and (is_large or _overlap(blob.mask(), unknown))

    def _resembling(self, image: Image, motion: Motion, track: ImageTrack) -> tuple[Mask, Mask]:
        """Pixels with the object's colours, and these with what moves along with them in a new colour.

        In reach of where the object should be and a little further: what is out of reach now may be in reach
        in the next image, and is known for another thing then. An object that moved lately is no background
        yet: what differs in nothing from the background is not the object.
        """
        alike, whole = (np.zeros(image.shape[:2], dtype=bool) for _ in range(2))
        reach = track.reach + REACH
        window = _window((track.center, track.expected), reach, image)
        has_colors, is_new = self._appearance.compare(image[window])
        extended = _extended(has_colors, is_new & motion.moving[window])
        changed = motion.changed(window) if self._is_fresh else True
        alike[window], whole[window] = has_colors & changed, extended & changed
        return alike, whole

    def _learn(self, image: Image, mask: Mask, maybe: Mask, motion: Motion, ignored: Mask | None) -> None:
        """Learn the colours of the object, and of what it could be confused with.

        That is what is ignored, what else moves, and, unless the object moves, what stands beside it.
        """
        left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
        if not width:
            return
        box, ends = (
            (slice(top, top + height), slice(left, left + width)),
            ((left, top), (left + width - 1, top + height - 1)),
        )
        far, near = _window(ends, REACH, image), _window(ends, NEAR, image)
        others = [image[far][motion.moving[far] & ~maybe[far]]]
        if ignored is not None:
            others.append(image[::THINNING, ::THINNING][ignored[::THINNING, ::THINNING]])
        if not self._is_fresh:
            others.append(image[near][~motion.moving[near] & ~maybe[near]])
        self._appearance.learn(image[box][mask[box]], np.concatenate(others))


def _regions(mask: Mask) -> list[Blob]:
    """The regions of a mask, with small gaps closed."""
    return find_blobs(cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_CLOSE, GAP) > 0)


def _window(places: tuple[tuple[float, float], ...], reach: float, image: Image) -> tuple[slice, slice]:
    """Rows and columns within reach of places, or of the points of the image nearest to them [px]."""
    edge = np.array((image.shape[1] - 1, image.shape[0] - 1))
    points = np.clip(np.array(places), 0, edge)
    first = np.maximum(points.min(axis=0) - reach, 0).astype(int)
    last = (points.max(axis=0) + reach).astype(int) + 1
    return slice(first[1], last[1]), slice(first[0], last[0])


def _overlap(mask: Mask, other: Mask) -> bool:
    """Whether a mask touches another."""
    return bool((mask & _grown(other, SPECK)).any())


def _opened(mask: Mask) -> Mask:
    """The mask without specks."""
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, SPECK) > 0


def _grown(mask: Mask, shape: np.ndarray) -> Mask:
    """The mask with a rim."""
    return cv2.dilate(mask.view(np.uint8), shape) > 0


def _extended(mask: Mask, more: Mask) -> Mask:
    """A mask with those connected regions of it and of more that are to a good part its own."""
    _, labels = cv2.connectedComponents((mask | more).view(np.uint8))
    own = np.bincount(labels[mask], minlength=labels.max() + 1)
    is_own = own >= LEAST_KNOWN * np.bincount(labels.ravel())
    is_own[0] = False
    return is_own[labels.astype(np.intp)]


def _prompted(box: tuple[float, float, float, float], image: Image) -> tuple[Mask, Mask]:
    """Where the object surely is, the ellipse that fills `INNER` of a box, and where it may be, the box."""
    xmin, ymin, xmax, ymax = box
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    across = (columns + 0.5 - 0.5 * (xmin + xmax)) / max(0.5 * (xmax - xmin), 1.0)
    down = (rows + 0.5 - 0.5 * (ymin + ymax)) / max(0.5 * (ymax - ymin), 1.0)
    inside = across**2 + down**2 <= INNER**2
    return inside, _grown((np.abs(across) <= 1.0) & (np.abs(down) <= 1.0), GAP)
