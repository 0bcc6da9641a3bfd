"""The tracker makes a box of every image; the prompter decides which of the things in it is the object."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import inf, isfinite, pi

import numpy as np

from pixel2catch.camera.image import Box, Edges, Image, Mask, Pixels, Verdict
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.foreground import Foreground, Weakness
from pixel2catch.perception.regions import USUAL, Blob, PlausibilityCfg, RobotMask, closed, find_blobs
from pixel2catch.perception.segmenter import (
    BoxPrompt,
    ColorRange,
    ImageMotion,
    Segmentation,
    Segmenter,
    check_image,
    largest_change,
)
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

PATIENCE = 5  #: Images without the object after which the prompter looks for it again. Source: ours.

LEAST_SPEED, LARGEST_SPEED = 7.0, 90.0
"""Smallest and largest motion of a flying thing between two images [px]. Source: ours; a throw begins with 10
or more, and rendered catches move by 61 at most."""

LEAST_AREA = 25  #: Of a thing that is found by its flight [px²]. Source: ours; smaller ones are noise.
LARGEST_GROWTH = 2.5  #: Largest ratio of the areas of a flying thing in two images. Source: ours.
LARGEST_FLICKER = 0.3  #: Share of the place of a flight that may have moved before. Source: ours.
STILL_TIME = 10 * CONTROL_DT  #: After which a thing that stands still is not the object [s]. Source: ours.

MOST_CANDIDATES, MOST_IMAGES = 20, 5
"""Most moving things of about one area in an image, and most images, in which flights are searched. Source:
ours; a crowd of specks is noise, and the work grows with the square of their number."""

LARGEST_CHANCE = 0.0002
"""Largest number of flights per image that things at random places may make. Source: ours: a thing that moves
alone needs three images, two need four."""

LARGEST_BEND, BEND_REACH = 1.25, 6.0
"""Largest distance of a flight from a parabola, and that of an image from where the others lead a flight that
keeps to it [px]. Source: public videos: hands and pieces of people bend more."""


class Prompter:
    """Points the object out before it is found, and after a loss.

    A person's box comes first, then the largest thing of its colour, then what flies: a thing of an object's
    size that moved along a parabola in three images, or up to five if other things move.
    """

    def __init__(
        self,
        prompt: BoxPrompt | None = None,
        *,
        colors: ColorRange | None = None,
        region: Edges | None = None,
    ) -> None:
        """Set where each throw begins, the object's colours, and the region in which it is searched."""
        self._usual, self._colors, self._region = prompt, colors, region
        self.limits = USUAL  #: What can be the object.
        self.reset()

    def reset(self) -> None:
        """Start a new throw."""
        self._given = self._usual
        self._recent: deque[Moving] = deque(maxlen=MOST_IMAGES)  # the newest image first

    def give(self, prompt: BoxPrompt) -> None:
        """Point the object out in the next image, once."""
        self._given = prompt

    def look(
        self, image: Pixels, motion: ImageMotion | None = None, interval: float = 1.0
    ) -> BoxPrompt | None:
        """Return where the object is in the newest image, in which some things may move, or None.

        The interval is the time since the image before [control steps].
        """
        given, self._given = self._given, None
        flying = self._flying(motion, interval)  # for every image, because it compares several
        colored = self._sized(self._colors.mask(image)) if self._colors and not given else []
        return given or (BoxPrompt(box=colored[0].box) if colored else flying)

    def _flying(self, motion: ImageMotion | None, interval: float) -> BoxPrompt | None:
        if motion is None:
            return None
        things = [blob for blob in motion.things if blob.is_plausible(self.limits)]
        things = self._sized(closed(motion.moving)) if self._region else things
        self._recent.appendleft((interval, things, motion.moving))
        large = () if motion.doubt == Weakness.FEW_IMAGES else things
        flying = (each for each in large if each.area >= LEAST_AREA and _flies(each, list(self._recent)))
        return next((BoxPrompt(box=blob.box, is_guess=True) for blob in flying), None)

    def _sized(self, mask: Mask) -> list[Blob]:
        """Regions with an object's size in the region of interest, the largest first."""
        height, width = mask.shape
        xmin, ymin, xmax, ymax = (max(round(edge), 0) for edge in self._region or (0, 0, width, height))
        place = slice(ymin, ymax), slice(xmin, xmax)
        blobs = find_blobs(mask[place], place, (height, width))
        return [blob for blob in blobs if blob.is_plausible(self.limits)]


Moving = tuple[float, list[Blob], Mask]
"""What moves in an image: the time since the image before, regions of an object's size, and all pixels."""


def _flies(blob: Blob, recent: list[Moving]) -> bool:
    """Whether a region of the newest image continues a flight that chance does not explain.

    Only things of about its area can be taken for it. Where it has come to, little moved in the first of the
    images, beside the thing itself: what flickers in its place is no flight.
    """
    low, high = blob.area / LARGEST_GROWTH, LARGEST_GROWTH * blob.area
    alike = [[each for each in things if low <= each.area <= high] for _, things, _ in recent]
    steps, flights = [interval for interval, _, _ in recent], [[blob]]
    chances, reach = np.array((len(recent[0][1]), len(alike[0]))), LARGEST_SPEED * steps[0]
    for number, (_, every, moving) in enumerate(recent[1:], start=2):
        things = alike[number - 1]
        if max(len(flights), len(things)) > MOST_CANDIDATES:
            return False
        flights = [[*flight, each] for flight in flights for each in things if _leads(each, flight, steps)]
        chances = chances * (pi * reach**2 / moving.size) * (len(every), len(things))
        reach = largest_change(*steps[:2]) if number == 2 else BEND_REACH
        if chances[number // MOST_IMAGES] <= LARGEST_CHANCE and number > 2:
            fresh = [blob.pixels(blob.place) & ~first.mask()[blob.place] for *_, first in flights]
            return any((moving[blob.place] & each).sum() <= LARGEST_FLICKER * each.sum() for each in fresh)
    return False


def _leads(blob: Blob, flight: list[Blob], steps: list[float]) -> bool:
    """Whether a region of an earlier image leads to the rest of a flight, by these times between images."""
    time_ago, away = sum(steps[: len(flight)]), blob.distance(flight[0].center)
    if not LEAST_SPEED * time_ago <= away <= LARGEST_SPEED * time_ago:
        return False
    if len(flight) == 1:
        return True
    after, interval = steps[len(flight) - 2 : len(flight)]
    u, v = (
        at + after / interval * (at - old) for at, old in zip(flight[-1].center, blob.center, strict=True)
    )
    if flight[-2].distance((u, v)) > largest_change(after, interval):
        return False
    terms = np.vander(np.cumsum((0.0, *steps[: len(flight)])), 3)
    centers = np.array([each.center for each in (*flight, blob)])
    left = centers - terms @ np.linalg.lstsq(terms, centers)[0]  # what no parabola explains
    return bool(np.hypot(*left.T).max() <= LARGEST_BEND)


@dataclass(kw_only=True)
class TrackState:
    """State of the tracker in one throw."""

    edges: Edges = (0.0, 0.0, 0.0, 0.0)  #: Last accepted box [px].
    seen_stamp: float = -inf  #: When its image was taken [s].
    image_stamp: float = -inf  #: When the last processed image was taken [s].
    num_lost: int = 0  #: Images since that box, or since the last prompt.
    has_jumped: bool = False  #: Whether a box since the last accepted one was refused as a jump.
    is_prompted: bool = False  #: Whether the segmenter has got a prompt.
    is_guess: bool = False  #: Whether the object was found by its flight alone.
    moved: tuple[Edges, float] = ((0.0, 0.0, 0.0, 0.0), -inf)  #: Box and stamp when it last moved [px, s].
    is_continued: bool = False  #: Whether the box is one of the thing of the last prompt.
    is_at_robot: bool = False  #: Whether the box touched the robot: no other object is searched then.

    def update(self, found: Box, stamp: float, ignored: Mask | None) -> None:
        """Take over the result for an image; without a new box, the last one is held."""
        if found.verdict is not Verdict.SEEN:
            self.num_lost += 1
            self.has_jumped |= found.verdict is Verdict.JUMP
            return
        self.edges, self.seen_stamp = found.edges, stamp
        self.num_lost, self.is_continued, self.has_jumped = 0, True, False
        xmin, ymin, xmax, ymax = map(int, found.edges)
        self.is_at_robot = ignored is not None and bool(ignored[ymin:ymax, xmin:xmax].any())
        moved = max(abs(edge - old) for edge, old in zip(found.edges, self.moved[0], strict=True))
        if moved >= LEAST_SPEED or self.is_at_robot:
            self.moved = found.edges, stamp


class ObjectTracker:
    """Makes a box of every image of a stream. It refuses a stream whose first image is unsuitable."""

    def __init__(
        self,
        segmenter: Segmenter,
        prompter: Prompter,
        *,
        robot: RobotMask | None = None,
        camera: CameraSpec = RGB_CAMERA,
        limits: PlausibilityCfg = USUAL,
        waits: bool = False,
    ) -> None:
        """Start before the first throw; the motion of the robot's pixels is ignored.

        If it `waits`, it only learns the background before the first reset.
        """
        self.durations: dict[str, float] = {}  #: Duration of each stage of the last step [s].
        self._segmenter, self._prompter, self._robot = segmenter, prompter, robot
        self._camera, self._usual = camera, limits
        self._set_limits(limits)
        self._foreground, self._state = Foreground(), TrackState()
        self._is_checked, self._has_begun = False, not waits

    def reset(self) -> None:
        """Start a new throw, whose stamps may start again. The background is kept."""
        self._segmenter.reset()
        self._prompter.reset()
        self._set_limits(self._usual)
        self._state, self._has_begun = TrackState(), True

    def settle(self) -> None:
        """Learn from the last image; else the next step does it."""
        self._segmenter.settle()
        self._foreground.settle()

    def step(self, image: Image | None, now: float) -> Box:
        """Process the newest image; call it once in every control step.

        Args:
            image: The newest image, which may be that of the step before; None if there is none yet.
            now: The time, by the clock of the stamps [s].

        Raises:
            PerceptionError: The very first image has the wrong size or encoding. Later ones are skipped.
        """
        self.durations = {}
        with self._stage("total"):
            found = self._process(image)
        state = self._state
        return replace(
            found,
            stamp=-inf if image is None else image.stamp,
            edges=state.edges,
            is_valid=state.seen_stamp > -inf,
            age=now - state.seen_stamp,
        )

    def _set_limits(self, limits: PlausibilityCfg) -> None:
        self._limits = self._segmenter.limits = self._prompter.limits = limits

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.durations[name] = time.perf_counter() - begin

    def _process(self, image: Image | None) -> Box:
        if image is None:
            return Box(verdict=Verdict.NO_IMAGE)
        if not image.stamp > self._state.image_stamp:
            return Box(verdict=Verdict.REPEATED)
        problem = Verdict.BAD_IMAGE
        try:
            check_image(image.pixels, self._camera.width, self._camera.height)
            self._is_checked, problem = True, Verdict.FAILED
            found = self._find(image)
        except PerceptionError as error:
            if not self._is_checked:
                raise
            found = Box(verdict=problem, message=str(error))
        self._state.image_stamp = image.stamp
        return found

    def _find(self, image: Image) -> Box:
        ignored = None
        if self._robot and image.joint_pos is not None:
            with self._stage("robot"):
                ignored = self._robot.at(image.joint_pos)
        with self._stage("segment"):
            interval = (image.stamp - self._state.image_stamp) / CONTROL_DT
            interval = interval if isfinite(interval) else 1.0  # the first image
            segmentation, doubt = self._segment(image.pixels, ignored, interval)
        with self._stage("box"):
            found = replace(self._judge(segmentation, image.stamp), doubt=doubt)
        self._state.update(found, image.stamp, ignored)
        is_still = found.verdict is Verdict.SEEN and image.stamp - self._state.moved[1] >= STILL_TIME
        if is_still and self._state.is_guess:
            self._segmenter.reset()
            self._state.is_prompted, found = False, Box(verdict=Verdict.NO_PROMPT, doubt=doubt)
        return found

    def _segment(self, image: Pixels, ignored: Mask | None, interval: float) -> tuple[Segmentation, str]:
        """Follow the object, or start at a prompt if it is lost; also return the doubt about it."""
        state = self._state
        is_lost = state.num_lost >= PATIENCE and not state.is_at_robot
        needs_prompt = is_lost or not state.is_prompted
        if not (needs_prompt or self._segmenter.uses_motion):
            return self._segmenter.find(image, interval=interval), ""
        motion = self._foreground.step(image, ignored)
        prompt = self._prompter.look(image, motion, interval) if needs_prompt else None
        prompt = prompt if self._has_begun else None
        if prompt is not None:
            state.is_guess = prompt.is_guess and (state.is_guess or not state.is_prompted)
            state.is_prompted, state.is_continued, state.num_lost = True, False, 0
            state.moved = prompt.box, state.image_stamp
            limits = self._limits if prompt.is_guess else self._usual
            self._set_limits(limits.including(prompt.box))
            motion = self._foreground.reveal(motion, prompt)
        segmentation = self._segmenter.find(image, motion, prompt, interval)
        self._foreground.keep(segmentation.mask)
        return segmentation, motion.doubt if self._segmenter.uses_motion else ""

    def _judge(self, segmentation: Segmentation, stamp: float) -> Box:
        """Return the box of the largest region, or why it is refused."""
        state, mask = self._state, segmentation.mask
        missing = Verdict.NOT_FOUND if state.is_prompted else Verdict.NO_PROMPT
        found = Box(verdict=missing, score=segmentation.score)
        if mask is None:
            return found
        blobs = find_blobs(mask)
        verdict = judge(self._limits, self._camera, blobs[0]) if blobs else Verdict.TOO_SMALL
        if verdict is not Verdict.SEEN:
            return replace(found, verdict=verdict)
        edges, steps = blobs[0].box, (stamp - state.seen_stamp) / CONTROL_DT  # infinite before the first
        is_far = self._limits.is_jump(edges, state.edges, steps)
        if is_far and state.is_continued:
            return replace(found, verdict=Verdict.JUMP)
        is_elsewhere = is_far or state.has_jumped
        return replace(found, verdict=verdict, edges=edges, mask=blobs[0].mask(), is_elsewhere=is_elsewhere)


def judge(limits: PlausibilityCfg, camera: CameraSpec, blob: Blob) -> Verdict:
    """Return `SEEN` if a region can be the object, or why it cannot."""
    xmin, ymin, xmax, ymax = blob.box
    if blob.area < limits.least_area:
        return Verdict.TOO_SMALL
    if blob.width * blob.height > limits.largest_share * camera.width * camera.height:
        return Verdict.TOO_LARGE
    if (xmin <= 0) + (ymin <= 0) + (xmax >= camera.width) + (ymax >= camera.height) > limits.largest_sides:
        return Verdict.BORDER
    return Verdict.SEEN
