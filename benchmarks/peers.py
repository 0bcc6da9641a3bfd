"""Ways to follow an object, all asked alike: ours, and what one would first write with OpenCV."""

import argparse
import json
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from math import hypot
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from pixel2catch.camera.image import Edges, Image, Pixels, Verdict
from pixel2catch.evaluation.box_scores import Score, score_box, summary
from pixel2catch.files import write_atomically
from pixel2catch.perception.background import BackgroundSubtraction
from pixel2catch.perception.labels import Truth
from pixel2catch.perception.regions import RobotMask
from pixel2catch.perception.segmenter import BoxPrompt, ColorRange, ColorThreshold, Segmenter
from pixel2catch.perception.tracker import ObjectTracker, Prompter

CLICK_ERROR = 2.0  #: How far each edge of a person's box is off at most [px]. Source: ours.
LARGEST_DISTANCE = 60.0  #: From the prediction to a region that is taken for the object [px]. Source: ours.
LARGEST_GROWTH = 3.0  #: How many times larger or smaller than before it may be. Source: ours.
LEAST_AREA = 12  #: Of a region [px]. Source: ours.
LEAST_DIFFERENCE = 20  #: Between two images, of 255. Source: ours.


class Method(Protocol):
    """Gets every image of a stream once: `see` until the object is pointed out by `start`, and after it."""

    def start(self, image: Image, box: Edges) -> Edges | None:
        """Look at the image in which a person says that the object is in this box."""

    def see(self, image: Image) -> Edges | None:
        """Return the object's box in the next image; None where it is not found."""


Made = dict[str, Callable[[], Method]]  #: Methods by name.
Images = Sequence[Image]
Truths = Sequence[Truth | None]


class Ours:
    """The perception of this project, as `track` runs it."""

    def __init__(self, segmenter: Segmenter, robot: RobotMask | None, *, is_told: bool = True) -> None:
        self._person, self._is_told = Prompter(), is_told
        self._tracker = ObjectTracker(segmenter, self._person, robot=robot, waits=is_told)

    def start(self, image: Image, box: Edges) -> Edges | None:
        if self._is_told:
            self._tracker.reset()
            self._person.give(BoxPrompt(box=box))
        return self.see(image)

    def see(self, image: Image) -> Edges | None:
        seen = self._tracker.step(image, image.stamp)
        return seen.edges if seen.verdict is Verdict.SEEN else None


def differences() -> Callable[[Pixels], np.ndarray]:
    """Return what makes the pixels 255 that differ from those of both of the last two images."""
    last: deque[Pixels] = deque(maxlen=2)

    def moving(image: Pixels) -> np.ndarray:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        differs = [cv2.absdiff(grey, before) > LEAST_DIFFERENCE for before in last]
        last.append(grey)
        return 255 * np.logical_and.reduce([*differs, np.full(grey.shape, bool(differs))])

    return moving


class NearestBlob(Method):
    """Of the regions that move, that nearest to where constant velocity leads."""

    def __init__(self, moving: Callable[[Pixels], np.ndarray]) -> None:
        """Start with what makes the moving pixels 255, such as a background subtractor."""
        self._moving = moving
        self._box: Edges | None = None
        self._velocity = (0.0, 0.0)
        self._num_lost = 0

    def start(self, image: Image, box: Edges) -> Edges | None:
        self._box, self._velocity, self._num_lost = box, (0.0, 0.0), 0
        return self.see(image)

    def see(self, image: Image) -> Edges | None:
        mask = (self._moving(image.pixels) == 255).astype(np.uint8)
        if self._box is None:
            return None
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        num, _, stats, centers = cv2.connectedComponentsWithStats(mask)
        steps = self._num_lost + 1
        (u, v), (left, top, right, bottom) = _middle(self._box), self._box
        area = (right - left) * (bottom - top)
        expected = u + steps * self._velocity[0], v + steps * self._velocity[1]
        best, best_distance = None, LARGEST_DISTANCE * steps
        for i in range(1, num):
            left, top, width, height, size = map(float, stats[i])
            ratio = width * height / max(area, 1.0)
            distance = hypot(centers[i][0] - expected[0], centers[i][1] - expected[1])
            fits = size >= LEAST_AREA and 1 / LARGEST_GROWTH <= ratio <= LARGEST_GROWTH
            if fits and distance < best_distance:
                best, best_distance = (left, top, left + width, top + height), distance
        if best is None:
            self._num_lost += 1
            return None
        now = _middle(best)
        self._velocity = (now[0] - u) / steps, (now[1] - v) / steps
        self._box, self._num_lost = best, 0
        return best


class Mil(Method):
    """OpenCV's tracker by multiple instance learning; the others in OpenCV 5 need weights."""

    def __init__(self) -> None:
        self._tracker, self._is_started = cv2.TrackerMIL.create(), False

    def start(self, image: Image, box: Edges) -> Edges | None:
        left, top, right, bottom = (round(edge) for edge in box)
        cv2.setRNGSeed(0)
        self._tracker.init(image.pixels, (left, top, max(right - left, 4), max(bottom - top, 4)))
        self._is_started = True
        return box

    def see(self, image: Image) -> Edges | None:
        if not self._is_started:
            return None
        is_found, (left, top, width, height) = self._tracker.update(image.pixels)
        return (float(left), float(top), float(left + width), float(top + height)) if is_found else None


def methods(hue: tuple[float, float] | None, robot: RobotMask | None = None) -> Made:
    """What makes each, by name; colour where the object's hue is known [degrees]."""
    made: Made = {
        "background": lambda: Ours(BackgroundSubtraction(), robot),
        "nearest blob": lambda: NearestBlob(
            cv2.createBackgroundSubtractorMOG2(300, 16.0, detectShadows=True).apply
        ),
        "differences": lambda: NearestBlob(differences()),
        "MIL": Mil,
    }
    if hue is not None:
        made["color"] = lambda: Ours(ColorThreshold(ColorRange(hue=hue)), robot)
    return made


def follow(method: Method, images: Images, truths: Truths, seed: int) -> list[Score]:
    """Show a method a stream; a person points the object out in the first image in which it is labelled.

    That image counts for nothing, and neither do images of which the truth is not known.
    """
    scores: list[Score] = []
    first = next(i for i, truth in enumerate(truths) if truth and truth.box)
    errors = np.random.default_rng(seed).uniform(-CLICK_ERROR, CLICK_ERROR, 4).tolist()
    last: Edges = (0.0, 0.0, 0.0, 0.0)
    for number, (image, truth) in enumerate(zip(images, truths, strict=True)):
        if number == first and truth and truth.box:
            a, b, c, d = (edge + error for edge, error in zip(truth.box, errors, strict=True))
            last = (a, b, max(c, a + 3.0), max(d, b + 3.0))
            found = method.start(image, last)
        else:
            found = method.see(image)
            if truth is not None and number > first:
                scores.append(score_box(truth, found or last, is_seen=found is not None))
        last = found or last
    return scores


class Results:
    """Scores of the methods by case, and the time that an image takes them."""

    def __init__(self, chosen: str) -> None:
        """Compare some methods, whose names are separated by commas; empty for all."""
        self._chosen = chosen.split(",") if chosen else None
        self._scores = defaultdict[str, dict[str, list[Score]]](dict)
        self._kinds = defaultdict[str, dict[str, list[Score]]](dict)
        self._seconds, self._num_images = defaultdict[str, float](float), Counter[str]()
        cv2.setNumThreads(1)

    def add(
        self,
        case: str | None,
        images: Images,
        truths: Truths,
        made: Made,
        seed: int,
        kinds: Iterable[str] = (),
    ) -> None:
        """Show a stream to the methods; count their scores for the case, if any, and each for its kind."""
        for name, make in made.items():
            if self._chosen is None or name in self._chosen:
                begin = time.thread_time()
                found = follow(make(), images, truths, seed)
                self._seconds[name] += time.thread_time() - begin
                self._num_images[name] += len(images)
                if case is not None:
                    self._scores[case].setdefault(name, []).extend(found)
                for kind, score in zip(kinds, found, strict=False):
                    self._kinds[kind].setdefault(name, []).append(score)

    def report(self, out: Path | None) -> None:
        """Print a table of the images in flight; write it as Markdown, and all numbers as JSON."""
        every = self._scores.values()
        pooled = {name: [row for each in every for row in each.get(name, ())] for name in self._seconds}
        cases = {**self._scores, "all": pooled, **self._kinds}
        report = {case: {name: summary(rows) for name, rows in each.items()} for case, each in cases.items()}
        took = {name: 1e3 * spent / self._num_images[name] for name, spent in self._seconds.items()}
        rows = [["in flight: within 5 px, false boxes", *took], ["---"] * (len(took) + 1)]
        for case, found in report.items():
            rows.append([case, *(_cell(found[name]["flight"]) if name in found else "" for name in took)])
        rows.append(["ms an image, of one core", *(f"{each:.2f}" for each in took.values())])
        text = "\n".join(f"| {' | '.join(row)} |" for row in rows)
        print(text)
        if out:
            numbers = json.dumps({**report, "ms an image": took}, indent=1)
            write_atomically({out: numbers.encode(), out.with_suffix(".md"): f"{text}\n".encode()})


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of every comparison."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", default="", help="some of the columns, by commas")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn, and of a person's error")
    parser.add_argument("--out", type=Path, help="JSON file")
    return parser


def _cell(flight: dict[str, Any]) -> str:
    if not flight["images"]:
        return "-"
    share, low, high = (100 * each for each in (flight["within_5px"], *flight["within_5px_interval"]))
    return f"{share:.0f} % ({low:.0f} to {high:.0f}) of {flight['images']}, {flight['false_boxes']}"


def _middle(box: Edges) -> tuple[float, float]:
    return 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
