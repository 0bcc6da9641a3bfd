"""The tracker makes a box of every image; the prompter decides which of the things in it is the object."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import inf, isfinite, pi

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

LEAST_SPEED, LARGEST_SPEED = 8.0, 90.0
"""Smallest and largest motion of a flying thing between two images [px]. Source: ours; a throw begins with 10
or more, and rendered catches move by 61 at most."""

LARGEST_GROWTH = 2.5  #: Largest ratio of the areas of a flying thing in two of three images. Source: ours.

MOST_CANDIDATES, MOST_IMAGES = 20, 5
"""Most moving things of an object's size in an image, and most images, in which flights are searched. Source:
ours; a crowd of specks is noise, and the work grows with the square of their number."""

LARGEST_CHANCE = 0.005
"""Largest number of flights per image that things at random places may make. Source: ours: with three things
an image, a flight needs three images, with ten it needs four."""


class Prompter:
    """Points the object out before it is found, and after a loss.

    A person's box comes first, then the largest thing of its colour, then what flies: a thing of an object's
    size that moved by about the same between three images, or more if many things move.
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
        self._recent: deque[tuple[float, list[Blob]]] = deque(maxlen=MOST_IMAGES)  # the newest image first

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
        if motion is None or motion.doubt == Weakness.FEW_IMAGES:
            return None
        things = [blob for blob in motion.things if blob.is_plausible(self.limits)]
        things = self._sized(closed(motion.moving)) if self._region else things
        self._recent.appendleft((interval, things if len(things) <= MOST_CANDIDATES else []))
        num_images = _num_images(list(self._recent), motion.moving.size)
        if num_images is None:
            return None
        recent = list(self._recent)[:num_images]
        (_, newest), (_, middle), *_ = recent
        flying = (now for now in newest for before in middle if _flies(now, before, recent))
        return next((BoxPrompt(box=blob.box, is_guess=True) for blob in flying), None)

    def _sized(self, mask: Mask) -> list[Blob]:
        """Regions with an object's size in the region of interest, the largest first."""
        height, width = mask.shape
        xmin, ymin, xmax, ymax = (max(round(edge), 0) for edge in self._region or (0, 0, width, height))
        place = slice(ymin, ymax), slice(xmin, xmax)
        blobs = find_blobs(mask[place], place, (height, width))
        return [blob for blob in blobs if blob.is_plausible(self.limits)]


Moving = list[tuple[float, list[Blob]]]
"""The moving things of successive images, the newest first, each with the time since the image before."""


def _num_images(recent: Moving, area: int) -> int | None:
    """Images that a flight needs to be distinguished from chance; None if there are too few.

    The area is of an image [px²].
    """
    if len(recent) < 3:
        return None
    (interval, newest), (before, middle), *earlier = recent
    chance = len(newest) * len(middle) * pi * (LARGEST_SPEED * interval) ** 2 / area
    for number, (next_interval, things) in enumerate(earlier, start=3):
        chance *= len(things) * pi * largest_change(interval, before) ** 2 / area
        if chance <= LARGEST_CHANCE:
            return number
        interval, before = before, next_interval
    return None


def _flies(now: Blob, middle: Blob, recent: Moving) -> bool:
    """Whether regions of the newest two images continue a flight through all the earlier ones."""
    (interval, _), (before, _), (_, firsts), *_ = recent
    if not LEAST_SPEED * interval <= now.distance(middle.center) <= LARGEST_SPEED * interval:
        return False
    change, share = largest_change(interval, before), interval / before
    for first in firsts:
        u, v = (at + share * (at - old) for at, old in zip(middle.center, first.center, strict=True))
        areas = (now.area, middle.area, first.area)
        is_continued = now.distance((u, v)) <= change and max(areas) <= LARGEST_GROWTH * min(areas)
        if is_continued and (len(recent) == 3 or _flies(middle, first, recent[1:])):
            return True
    return False


@dataclass(kw_only=True)
class TrackState:
    """State of the tracker in one throw."""

    edges: Edges = (0.0, 0.0, 0.0, 0.0)  #: Last accepted box [px].
    seen_stamp: float = -inf  #: When its image was taken [s].
    image_stamp: float = -inf  #: When the last processed image was taken [s].
    num_lost: int = 0  #: Images since that box, or since the last prompt.
    has_jumped: bool = False  #: Whether a box since the last accepted one was refused as a jump.
    is_prompted: bool = False  #: Whether the segmenter has got a prompt.
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
        """Find the object in an image of the camera's size, and update the state."""
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
            state.is_prompted, state.is_continued, state.num_lost = True, False, 0
            if not prompt.is_guess:
                self._set_limits(self._usual.including(prompt.box))
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
