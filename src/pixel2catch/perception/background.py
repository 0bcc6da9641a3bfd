"""The object by its motion and its colours: what differs from the background near its expected place."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from math import hypot, inf, pi
from operator import itemgetter

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from pixel2catch.camera.image import Edges, Mask, Pixels
from pixel2catch.perception.foreground import (
    INNER,
    LEARNING_IMAGES,
    opaque,
    prompted,
    shaded,
    sharpened,
    steady,
)
from pixel2catch.perception.regions import GAP, SPECK, Blob, Window, grown, grown_window, regions, window_of
from pixel2catch.perception.segmenter import (
    LARGEST_GROWTH,
    NOT_FOUND,
    REACH,
    ImageMotion,
    ImageTrack,
    Motion,
    Prompt,
    Segmentation,
    Segmenter,
)

LEAST_SHARE = 0.5  #: Smallest area of the object over before. Source: ours.
BOX_ERROR = 2.0  #: By which each edge of a person's box may be too far inside [px]. Source: ours.
LEAST_KNOWN = 0.2  #: Least share of a region with the object's colours, the rest being unseen. Source: ours.
LEAST_OWN = 0.5  #: Share of own colours from which a thing without them is another one. Source: ours.
LARGEST_RATIO = 4.0  #: Of the areas of a lost object and of a flight that is taken for it. Source: ours.

#: Largest weight of the earlier width, height and area of the object, in every image. Source: ours.
SIZE_MEMORY = np.array((0.5, 0.5, 0.7))

AREA_WEIGHT = 0.6  #: Of a change of the area over that of a side, which is more certain. Source: ours.
NUM_SURE = 3  #: Masks before those without shadows.

CLEAR_COST, LARGEST_CLEAR_CHANGE = 0.25, 0.6
"""Added to the cost of a region without what can be a shadow, and largest difference of its size. Source:
ours: a dark side of the object can be taken for its shadow."""

NEAR = 10.0  #: Distance up to which still things are learned as other things [px]. Source: ours.
THINNING = 2  #: Of the ignored pixels, every second row and column is learned as other things.

LEAST_STILL = 0.5  #: Share of unchanged pixels from which a region stands still. Source: ours.

LEAST_SPEED, NUM_FRESH = 3.0, LEARNING_IMAGES // 3
"""Speed from which the object moves [px per image], and images after that in which it is not yet background:
until then a region that equals the background is not the object. Source: ours."""

SHIFT = 4  #: A colour is the upper four bits of each channel: 16 levels. Source: ours.
LEVELS = 256 >> SHIFT
FADE = 0.8  #: Factor on the colours of earlier images at each new one. Source: ours, five images.
LEAST_COUNT = 0.1  #: Pixels of a colour and its neighbours below which it is unknown. Source: ours.
Size = Float[np.ndarray, "3"]  #: Width, height [px] and area [px²].
Colors = UInt8[np.ndarray, "_ 3"]  #: Red, green and blue of some pixels.
Histogram = Float32[np.ndarray, " num_colors"]  #: Pixels of each colour; older images count less.


class BackgroundSubtraction(Segmenter):
    """Follows what has the object's colours, or moves, near the object's expected place.

    The camera must not move. The colours are learned from the prompt and during the flight. They separate
    the object from an arm beside it, and show it at the robot, where motion is ignored. An object without
    colours of its own is followed by its motion alone.
    """

    uses_motion = True

    def __init__(self) -> None:
        self._track: ImageTrack | None = None
        self._appearance, self._num_still = Appearance(), inf
        self._size: Size | None = None
        self._shown = 0.0  # area in the prompt, where the image's edge may cut the object [px²]
        # The image in which it was last seen, and where it was there or something changed since.
        self._seen: tuple[Pixels, Mask] | None = None
        self._later: partial[None] | None = None

    def find(
        self, image: Pixels, motion: Motion = None, prompt: Prompt = None, interval: float = 1.0
    ) -> Segmentation:
        """See `Segmenter.find`. A guess that does not resemble the last object is ignored."""
        self.settle()
        is_known = self._track is not None and prompt is not None and prompt.is_guess
        if prompt is None or (is_known and not self._resembles(image, prompt.box)):
            self._track = self._track and self._track.after(interval)
            return self._follow(motion, None)
        self._track, self._seen = ImageTrack(center=prompt.center, limits=self.limits), None
        self._appearance, self._num_still, self._size = Appearance(), inf, None
        return self._follow(motion, prompt)

    def settle(self) -> None:
        """See `Segmenter.settle`: learn the colours."""
        later, self._later = self._later, None
        if later:
            later()

    def reset(self) -> None:
        """See `Segmenter.reset`."""
        self._track = None

    def _follow(self, motion: Motion, prompt: Prompt) -> Segmentation:
        assert motion is not None
        if self._track is None:
            return NOT_FOUND
        maybe = None
        if prompt is not None:
            inside, maybe = prompted(prompt.box, motion.image)
            self._shown = float(inside.sum()) / INNER**2
            if not any(blob.is_cut for blob in regions(maybe)):  # the size of an ellipse that fills the box
                xmin, ymin, xmax, ymax = prompt.box
                width, height = max(xmax - xmin, 1.0), max(ymax - ymin, 1.0)
                self._size = np.array((width, height, 0.25 * pi * width * height))
            self._learn(motion, inside, maybe)
        self._track = self._track.behind(motion.things, inf if self._size is None else float(self._size[2]))
        blobs, blob = self._object(motion, self._track, maybe)
        self._track, segmentation = self._track.advanced(blobs, blob, motion.things)
        is_moving = blob is not None and prompt is None and hypot(*self._track.velocity) >= LEAST_SPEED
        self._num_still = 0 if is_moving else self._num_still + 1
        seen = self._seen if self._num_still < NUM_FRESH else None
        if segmentation.mask is not None:
            self._seen = motion.image, grown(segmentation.mask, GAP)
        elif self._seen is not None:
            before, changed = self._seen
            self._seen = before, changed | ~steady(motion.image, before)
        if blob is not None and self._seen is not None and not _touches(blob, motion.unknown):
            mask = blob.mask()
            if maybe is None or not np.array_equal(mask, maybe):  # a box's area is not the object's
                self._resize(blob, self._track.num_seen)
                segmentation = replace(segmentation, mask=opaque(blob, motion))
            self._later = partial(self._learn, motion, mask, self._seen[1], seen)
        return segmentation

    def _object(
        self, motion: ImageMotion, track: ImageTrack, within: Mask | None
    ) -> tuple[list[Blob], Blob | None]:
        """Return the regions of the image, and the one that is the object; None if none is.

        The object flies on, or is stopped by a hand on its way; else it bounced off something. In a person's
        box `within`, it may fill little of it, as a cross does. What stands still is the object, caught, only
        if nothing else can be.
        """
        resting: tuple[list[Blob], Blob] | None = None
        blobs: list[Blob] = []
        for is_turned in (False, True):
            for blobs, best in self._found(motion, track, within, is_turned=is_turned):
                if best is None:
                    continue
                has_moved = hypot(*track.velocity) * track.age >= 0.5 * min(best.width, best.height)
                if not (has_moved and self._still(motion.image, best) >= LEAST_STILL):
                    return blobs, best
                resting = resting or (blobs, best)
        if resting or within is None:
            return resting or (blobs, None)
        return (blobs := regions(within)), next(iter(blobs), None)

    def _found(
        self, motion: ImageMotion, track: ImageTrack, within: Mask | None, *, is_turned: bool
    ) -> Iterator[tuple[list[Blob], Blob | None]]:
        """Regions of the image, and one of them that can be the object, the likeliest first.

        First come regions with the object's colours (see `_resembling`), then whatever moves. The one of the
        object's size is chosen, near the expected place if there is one.
        """
        shape, largest = motion.moving.shape, REACH if self._size is None else float(self._size[:2].max())
        reach = (track.reach if is_turned else track.nearness) + max(REACH, largest)
        places = np.clip((track.center, track.expected), 0.0, np.array(shape[::-1]) - 1.0)
        left, top = np.maximum(places.min(0) - reach, 0.0).astype(int).tolist()
        right, bottom = (places.max(0) + reach + 1.0).astype(int).tolist()
        near = slice(top, bottom), slice(left, right)
        window = grown_window(window_of(motion.moving[near] | motion.unknown[near], near), len(GAP) // 2 + 1)
        inside = True if within is None else within[window]
        resembling = [regions(mask & inside, window, shape) for mask in self._resembling(motion, window)]
        things = motion.things if within is None else regions(motion.moving & within)
        leasts = (LEAST_SHARE, LEAST_KNOWN) if track.num_seen == 1 else (LEAST_SHARE,)
        error = BOX_ERROR if track.num_seen == 1 else 0.0
        has_own = self._appearance.own_share >= LEAST_OWN
        for least, choices in product(leasts, (resembling, [things])):
            found = []
            is_alike = choices is resembling
            # On its way, an object without own colours needs motion alone; elsewhere nothing else must move.
            is_likely = is_alike and has_own if is_turned else is_alike or not has_own
            for number, blobs in enumerate(choices):
                candidates = [blob for blob in track.candidates(blobs) if is_turned or track.passes(blob)]
                fitting = [blob for blob in candidates if self._fits(blob, motion, least, error)]
                is_enough = is_likely or (len(fitting) == 1 and not fitting[0].is_cut)
                if blob := next((each for each in fitting if is_enough or track.leads_to(each)), None):
                    cost = self._cost(track, blob, is_clear=number >= NUM_SURE)
                    found += [(cost, (blobs, blob))] if cost[1] < inf else []
            if found:
                yield min(found, key=itemgetter(0))[1]
        yield (resembling[2], None)

    def _fits(self, blob: Blob, motion: ImageMotion, least: float, error: float) -> bool:
        """Whether a region has the object's size, and was not there when the object was elsewhere."""
        if self._size is None and blob.area < LEAST_SHARE * self._shown:
            return False
        width, height, area = (_size(blob) if self._size is None else self._size).tolist()
        is_whole = blob.area >= least * area or blob.is_cut or _touches(blob, motion.unknown)
        largest = LARGEST_GROWTH * area * (1.0 + 2.0 * error / width) * (1.0 + 2.0 * error / height)
        return blob.area <= largest and is_whole and self._still(motion.image, blob, apart=True) < LEAST_STILL

    def _still(self, image: Pixels, blob: Blob, *, apart: bool = False) -> float:
        """Share of a region that is unchanged since the object was last seen, there or apart from there."""
        if self._seen is None:
            return 0.0
        before, place = (each[blob.place] for each in self._seen)
        same = blob.pixels(blob.place) & steady(image[blob.place], before)
        return float((same & ~place if apart else same).sum() / blob.area)

    def _cost(self, track: ImageTrack, blob: Blob, *, is_clear: bool) -> tuple[bool, float]:
        """How unlike the object a region is: far off, then by its distance and its size.

        The latter is the difference of its sides or its area in logarithms, the larger of the two. A region
        that is clear of what can be a shadow needs the object's size.
        """
        distance, change = blob.distance(track.expected) / REACH, 0.0
        if self._size is not None:
            width, height, area = np.abs(np.log(_size(blob) / self._size)).tolist()
            change = max(width + height, AREA_WEIGHT * area)
        if is_clear:
            change = change + CLEAR_COST if change <= LARGEST_CLEAR_CHANGE else inf
        return distance > max(track.interval, 1.0), 0.5 * distance + change

    def _resize(self, blob: Blob, num_seen: int) -> None:
        """Update the size of an object that was seen so often, as a mean in which later images count more.

        If the image's edge cuts the region, its whole side gives the growth of all sides.
        """
        size, before = _size(blob), self._size
        if before is None:
            self._size = None if blob.is_cut else size
            return
        memory = np.minimum(SIZE_MEMORY, num_seen / (num_seen + 1.0))
        learned = memory * before + (1.0 - memory) * size
        if blob.is_cut:
            growth = np.max((learned / before)[:2], initial=1.0, where=np.array(blob.is_whole))
            learned = before * (growth, growth, growth**2)
        self._size = learned

    def _resembling(self, motion: ImageMotion, window: Window) -> list[Mask]:
        """Masks of a window, of pixels that differ from the background or have none.

        They show moving things with the object's colours, the parts of them with the object's or new colours,
        and the parts with the object's colours alone. If something can be a shadow, two more show the first
        two without it.
        """
        has_colors, is_new = self._appearance.compare(motion.image[window])
        sharp, shade = sharpened(motion, window), shaded(motion, window)
        extended = _extended(has_colors, is_new & motion.moving[window])
        changed = sharp | motion.unknown[window]
        masks = [_extended(has_colors & sharp, sharp), extended & changed, has_colors & changed]
        if shade.any():
            clear = sharp & ~shade
            masks += [_extended(has_colors & clear, clear), extended & (clear | motion.unknown[window])]
        return masks

    def _resembles(self, image: Pixels, box: Edges) -> bool:
        """Whether the content of a box has the size of the last object, and its colours if it has any."""
        inside, _ = prompted(box, image)
        area = float(inside.sum()) / INNER**2
        if self._size is not None and not 1 / LARGEST_RATIO <= area / self._size[2] <= LARGEST_RATIO:
            return False
        has_colors, _ = self._appearance.compare(cv2.blur(image, (3, 3)))
        least = LEAST_KNOWN * self._appearance.own_share
        return bool(has_colors[inside].sum() >= least * inside.sum())

    def _learn(
        self, motion: ImageMotion, mask: Mask, maybe: Mask, seen: tuple[Pixels, Mask] | None = None
    ) -> None:
        """Learn the colours of the object and of other things.

        These are ignored pixels, what else moves, and, unless the object moved lately, what is beside it.
        What stands still since the object was seen elsewhere need not differ in colour.
        """
        image, ignored = motion.image, motion.ignored
        box = window_of(mask)
        if not mask[box].size:
            return
        far, near = grown_window(box, REACH), grown_window(box, NEAR)
        moving = motion.moving[far] & ~maybe[far]
        if seen is not None:
            moving &= ~steady(image[far], seen[0][far]) | seen[1][far]
        others = [image[far][moving]]
        if ignored is not None:
            others.append(image[::THINNING, ::THINNING][ignored[::THINNING, ::THINNING]])
        if self._num_still >= NUM_FRESH:
            others.append(image[near][~motion.moving[near] & ~maybe[near]])
        self._appearance.learn(image[box][mask[box]], np.concatenate(others))


class Appearance:
    """Histograms of the object's colours and of all other things'. A colour is of that with more pixels."""

    own_share: float  #: Share of the object that has colours of its own.

    def __init__(self) -> None:
        self._object = self._other = np.zeros(LEVELS**3, dtype=np.float32)
        self.learn(*[np.zeros((0, 3), dtype=np.uint8)] * 2)

    def learn(self, pixels: Colors, others: Colors) -> None:
        """Learn pixels of the object in an image, and pixels of other things."""
        self._object, self._other = _faded(self._object, pixels), _faded(self._other, others)
        other = _spread(self._other)
        self._is_likely = _spread(self._object) > np.maximum(other, LEAST_COUNT)
        self._is_new = other <= LEAST_COUNT
        self.own_share = float(self._object[self._is_likely].sum() / max(self._object.sum(), LEAST_COUNT))

    def compare(self, image: Pixels) -> tuple[Mask, Mask]:
        """Return the pixels with the object's colours, and those with colours that no other thing has.

        The latter may show an unseen side of the object. The former is empty if its colours are unknown.
        """
        codes = _codes(image)
        return self._is_likely[codes], self._is_new[codes]


def _codes(colors: UInt8[np.ndarray, "*places 3"]) -> Int[np.ndarray, "*places"]:
    levels = colors >> SHIFT
    return (levels[..., 0].astype(np.intp) * LEVELS + levels[..., 1]) * LEVELS + levels[..., 2]


def _faded(histogram: Histogram, colors: Colors) -> Histogram:
    counts = np.bincount(_codes(colors), minlength=len(histogram)).astype(np.float32)
    return FADE * histogram + (1.0 - FADE) * counts


def _spread(histogram: Histogram) -> Histogram:
    """The histogram, blurred over neighbouring colours, because the lighting of the object changes."""
    cube = histogram.reshape(LEVELS, LEVELS * LEVELS)
    for _ in range(3):  # one channel at a time; the transposition brings the next to the front
        cube = cv2.blur(np.ascontiguousarray(cube), (1, 3), borderType=cv2.BORDER_CONSTANT)
        cube = cube.reshape(LEVELS, LEVELS, LEVELS).transpose(1, 2, 0).reshape(LEVELS, LEVELS * LEVELS)
    return cube.reshape(-1)


def _size(blob: Blob) -> Size:
    return np.array((blob.width, blob.height, blob.area), dtype=float)


def _touches(blob: Blob, mask: Mask) -> bool:
    place = grown_window(blob.place, 1)
    return bool((grown(blob.pixels(place), SPECK) & mask[place]).any())


def _extended(mask: Mask, more: Mask) -> Mask:
    """The connected regions of a mask and of more, as far as a sufficient share of each is in the mask."""
    num, labels = cv2.connectedComponents((mask | more).view(np.uint8))
    own, size = (np.bincount(labels[each], minlength=num) for each in (mask, mask | more))
    is_own = own >= LEAST_KNOWN * size
    is_own[0] = False
    return np.take(is_own, labels.astype(np.intp))
