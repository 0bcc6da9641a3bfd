"""Ways to follow an object, all asked alike: ours, and what one would first write with OpenCV."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from math import hypot
from typing import Final, final

import cv2
import numpy as np

from pixel2catch.camera.image import Edges, Image, Pixels, Verdict
from pixel2catch.evaluation.box_scores import Score, score_box
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.labels import Truth
from pixel2catch.perception.segmenter import BoxPrompt, ColorRange, ColorThreshold, Segmenter
from pixel2catch.perception.tracker import ObjectTracker, Prompter
from pixel2catch.scene.constants import CONTROL_DT

CLICK_ERROR = 2.0  #: How far each edge of a person's box is off at most [px]. Source: ours.
LARGEST_DISTANCE = 60.0  #: From the prediction to a region that is taken for the object [px]. Source: ours.
LARGEST_GROWTH = 3.0  #: How many times larger or smaller than before it may be. Source: ours.
LEAST_AREA = 12  #: Of a region [px]. Source: ours.


class Method(ABC):
    """Gets every image of a stream once: `learn` until the object is pointed out by `start`, then `see`."""

    @abstractmethod
    def learn(self, image: Pixels) -> None:
        """Look at an image before anything is pointed out."""

    @abstractmethod
    def start(self, image: Pixels, box: Edges) -> Edges | None:
        """Look at the image in which a person says that the object is in this box."""

    @abstractmethod
    def see(self, image: Pixels) -> Edges | None:
        """Return the object's box in the next image; None where it is not found."""


@final
class Ours(Method):
    """The perception of this project, as `track` runs it."""

    def __init__(self, segmenter: Segmenter) -> None:
        self._person: Final = Prompter()
        self._tracker = ObjectTracker(segmenter, self._person, waits=True)
        self._num_seen = 0

    def learn(self, image: Pixels) -> None:
        self.see(image)

    def start(self, image: Pixels, box: Edges) -> Edges | None:
        self._tracker.reset()
        self._person.give(BoxPrompt(box=box))
        return self.see(image)

    def see(self, image: Pixels) -> Edges | None:
        now = self._num_seen * CONTROL_DT
        self._num_seen += 1
        seen = self._tracker.step(Image(pixels=image, stamp=now), now)
        return seen.edges if seen.verdict is Verdict.SEEN else None


@final
class NearestBlob(Method):
    """MOG2, and of its regions that nearest to where constant velocity leads."""

    def __init__(self) -> None:
        self._model = cv2.createBackgroundSubtractorMOG2(300, 16.0, detectShadows=True)
        self._box: Edges = (0.0, 0.0, 0.0, 0.0)
        self._velocity = (0.0, 0.0)
        self._num_lost = 0

    def learn(self, image: Pixels) -> None:
        self._model.apply(image)

    def start(self, image: Pixels, box: Edges) -> Edges | None:
        self._box, self._velocity, self._num_lost = box, (0.0, 0.0), 0
        return self.see(image)

    def see(self, image: Pixels) -> Edges | None:
        mask = (self._model.apply(image) == 255).astype(np.uint8)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        num, _, stats, centers = cv2.connectedComponentsWithStats(mask)
        steps = self._num_lost + 1
        (u, v), area = _middle(self._box), _area(self._box)
        expected = u + steps * self._velocity[0], v + steps * self._velocity[1]
        best, best_distance = None, LARGEST_DISTANCE * steps
        for i in range(1, num):
            left, top, width, height, size = stats[i].tolist()
            ratio = width * height / max(area, 1.0)
            distance = hypot(centers[i][0] - expected[0], centers[i][1] - expected[1])
            fits = size >= LEAST_AREA and 1 / LARGEST_GROWTH <= ratio <= LARGEST_GROWTH
            if fits and distance < best_distance:
                best, best_distance = (left, top, left + width, top + height), distance
        if best is None:
            self._num_lost += 1
            return None
        box = (float(best[0]), float(best[1]), float(best[2]), float(best[3]))
        now = _middle(box)
        self._velocity = (now[0] - u) / steps, (now[1] - v) / steps
        self._box, self._num_lost = box, 0
        return box


@final
class Mil(Method):
    """OpenCV's tracker by multiple instance learning; the others in OpenCV 5 need weights."""

    def __init__(self) -> None:
        self._tracker = cv2.TrackerMIL.create()

    def learn(self, image: Pixels) -> None:
        pass

    def start(self, image: Pixels, box: Edges) -> Edges | None:
        left, top, right, bottom = (round(edge) for edge in box)
        cv2.setRNGSeed(0)
        self._tracker.init(image, (left, top, max(right - left, 4), max(bottom - top, 4)))
        return box

    def see(self, image: Pixels) -> Edges | None:
        is_found, (left, top, width, height) = self._tracker.update(image)
        return (float(left), float(top), float(left + width), float(top + height)) if is_found else None


def methods(hue: tuple[float, float] | None) -> dict[str, Callable[[], Method]]:
    """What makes each, by name; colour where the object's hue is known [degrees]."""
    made: dict[str, Callable[[], Method]] = {
        "background": lambda: Ours(BackgroundSubtraction()),
        "nearest blob": NearestBlob,
        "MIL": Mil,
    }
    if hue is not None:
        colors = ColorRange(hue=hue)
        made["color"] = lambda: Ours(ColorThreshold(colors))
    return made


def follow(method: Method, images: list[Pixels], truths: list[Truth | None], seed: int) -> list[Score]:
    """Show a method a stream; a person points the object out in the first image in which it is labelled.

    That image counts for nothing, and neither do images of which the truth is not known.
    """
    scores: list[Score] = []
    first = next(i for i, truth in enumerate(truths) if truth and truth.box)
    errors = np.random.default_rng(seed).uniform(-CLICK_ERROR, CLICK_ERROR, 4).tolist()
    last: Edges = (0.0, 0.0, 0.0, 0.0)
    for number, (image, truth) in enumerate(zip(images, truths, strict=True)):
        if number < first:
            method.learn(image)
            continue
        if number == first:
            assert truth is not None
            assert truth.box is not None
            a, b, c, d = (edge + error for edge, error in zip(truth.box, errors, strict=True))
            last = (a, b, max(c, a + 3.0), max(d, b + 3.0))
            found = method.start(image, last)
        else:
            found = method.see(image)
            if truth is not None:
                scores.append(score_box(truth, found or last, is_seen=found is not None))
        last = found or last
    return scores


def _middle(box: Edges) -> tuple[float, float]:
    return 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])


def _area(box: Edges) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])
