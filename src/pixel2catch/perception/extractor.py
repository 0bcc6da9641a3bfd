"""Images to pixel features, once in every control step: as `envs.detector` gives training, of a camera.

An image goes through the segmenter to a mask, its largest region to a box, and a plausible box to features.
Box and features are computed by the functions of training, `camera.boxes`. How long each stage takes is kept.
"""

import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.camera.boxes import pixel_features
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.foreground import Foreground
from pixel2catch.perception.image_track import find_blobs
from pixel2catch.perception.plausibility import PlausibilityCfg, Verdict, is_jump, judge
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Mask, Segmentation, Segmenter, check_image
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

LARGEST_AGE = 2.5 * CONTROL_DT
"""Age up to which a box is fresh [s]. Source: release; in training boxes are one or two steps old."""

MEMORY = 10_000  #: Durations that are kept of each stage: five minutes at 30 Hz.


@dataclass(frozen=True, kw_only=True)
class CameraFrame:
    """One image of the camera; whether it is one is checked by whoever gets it."""

    image: np.ndarray  #: Red, green, blue; upper row first.
    stamp: float  #: When it was taken [s].
    joint_pos: np.ndarray | None = None  #: The robot's at that time, in joint order [rad]; None if unknown.


@dataclass(frozen=True, kw_only=True)
class ExtractorCfg:
    """When a box counts, and after how many images without one the prompter is asked again. Source: ours."""

    plausibility: PlausibilityCfg = field(default_factory=PlausibilityCfg)
    patience: int = 5


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What became of one image."""

    verdict: Verdict  #: Only `SEEN` gives a new box.
    score: float = 0.0  #: The segmenter's score of this image, on its own scale; 0 where it was not asked.
    mask: Mask | None = None  #: The object's pixels, where it was seen.
    box: Float[Tensor, "1 4"] | None = None  #: About them [px].
    message: str = ""  #: What went wrong with an image that could not be used.
    #: Whether the box does not continue the one before it: no thrown object moves so.
    is_elsewhere: bool = False
    source: str = ""  #: Which of several segmenters was believed, see `Segmentation`.
    doubt: str = ""  #: What speaks against it, see `Segmentation`.


@dataclass(frozen=True, kw_only=True)
class Extraction(Finding):
    """What a control step knows of the object: the box for the policy, the rest for log and safety."""

    #: `Measurement.box` of training [px]; zeros before the first detection.
    box: Float[Tensor, "1 4"] = field(default_factory=lambda: torch.zeros(1, 4))
    #: That of the step before; the first box of a throw stands for its predecessor, as at the beginning of an
    #: episode.
    before: Float[Tensor, "1 4"]
    camera: CameraSpec = RGB_CAMERA  #: What they are seen with.
    is_valid: bool  #: Whether the object was seen in this throw.
    is_fresh: bool  #: Whether the box is no older than those of training.
    age: float  #: Time since the image of the box [s]; infinite before the first detection.
    num_skipped: int  #: Control steps without an image since the last: so many too many are in differences.

    @cached_property
    def features(self) -> Float[Tensor, "1 8"]:
        """The pixel features of the box and that of the step before, for show."""
        return pixel_features(self.before, self.box, self.camera)


@dataclass(kw_only=True)
class TrackState:
    """What is known of the object in this throw."""

    box: Float[Tensor, "1 4"] = field(default_factory=lambda: torch.zeros(1, 4))  #: Last accepted [px].
    box_stamp: float = -torch.inf  #: When its image was taken [s].
    image_stamp: float = -torch.inf  #: When the last image was taken that was looked at [s].
    num_lost: int = 0  #: Images since that box, or since the object was pointed out.
    has_jumped: bool = False  #: Whether a box was refused since that one, as no object moves so.
    is_pointed_out: bool = False  #: Whether the segmenter was told what the object is.
    is_continued: bool = False  #: Whether the box is one of the thing that was last pointed out.
    #: Whether the box touched the robot. What vanished there is taken to be in its hand: then nothing else is
    #: looked for, and only the segmenter can find it again.
    is_at_robot: bool = False

    @property
    def is_valid(self) -> bool:
        """Whether the object was ever seen."""
        return self.box_stamp > -torch.inf

    def num_skipped(self, stamp: float) -> int:
        """Control steps without an image between the last image and one of this time."""
        if self.image_stamp == -torch.inf or not stamp > self.image_stamp:
            return 0
        return max(round((stamp - self.image_stamp) / CONTROL_DT) - 1, 0)

    def count(self, finding: Finding, stamp: float, ignored: Mask | None) -> None:
        """Take over what was found in an image of this time; where nothing was, the box is held."""
        if finding.box is None:
            self.num_lost += 1
            self.has_jumped |= finding.verdict is Verdict.JUMP
            return
        self.box, self.box_stamp = finding.box, stamp
        self.num_lost, self.is_continued, self.has_jumped = 0, True, False
        xmin, ymin, xmax, ymax = map(int, finding.box[0].tolist())
        self.is_at_robot = ignored is not None and bool(ignored[ymin:ymax, xmin:xmax].any())


@dataclass(frozen=True, kw_only=True)
class Percentiles:
    """Durations of one stage [s]: half of them, 95 % and 99 % were shorter; and how many there were."""

    p50: float
    p95: float
    p99: float
    count: int

    @classmethod
    def of(cls, durations: Iterable[float]) -> "Percentiles":
        """Those of some durations [s]."""
        values = list(durations)
        p50, p95, p99 = np.percentile(values, (50, 95, 99)).tolist()
        return cls(p50=p50, p95=p95, p99=p99, count=len(values))


class StageClock:
    """Measures named stages and keeps their latest durations."""

    def __init__(self) -> None:
        """Begin with no stage."""
        self._durations: dict[str, deque[float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure what runs in this context, be it left by an error."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._durations.setdefault(name, deque(maxlen=MEMORY)).append(time.perf_counter() - begin)

    def percentiles(self) -> dict[str, Percentiles]:
        """Durations by stage, in the order in which the stages first ended."""
        return {name: Percentiles.of(durations) for name, durations in self._durations.items()}


class PixelFeatureExtractor:
    """Makes boxes and features of a stream of images; an image of a wrong kind is refused at the start."""

    def __init__(
        self,
        segmenter: Segmenter,
        prompter: Prompter,
        *,
        robot: RobotMask | None = None,
        camera: CameraSpec = RGB_CAMERA,
        cfg: ExtractorCfg | None = None,
        waits: bool = False,
    ) -> None:
        """Begin before the first throw.

        The motion of the robot is not the object's; None where that does no harm. One who waits only learns,
        and looks for no object, before the first throw begins with a reset.
        """
        self.clock = StageClock()  #: How long each stage took.
        self._segmenter, self._prompter, self._robot = segmenter, prompter, robot
        self._camera, self._cfg = camera, cfg or ExtractorCfg()
        for each in (segmenter, prompter):
            each.expect(self._cfg.plausibility)
        self._foreground, self._state = Foreground(), TrackState()
        self._is_checked, self._has_begun = False, not waits

    def reset(self) -> None:
        """Begin a new throw, whose stamps may begin anew; what is known of the background stays."""
        self._segmenter.reset()
        self._prompter.reset()
        self._state, self._has_begun = TrackState(), True

    def settle(self) -> None:
        """See `Segmenter.settle`."""
        self._segmenter.settle()
        self._foreground.settle()

    def step(self, frame: CameraFrame | None, now: float) -> Extraction:
        """Process the newest image; call it once in every control step, by the clock of the stamps [s].

        The image may be that of the step before; None if there is none yet.

        Raises:
            PerceptionError: If the very first image has the wrong size or encoding; later it is passed over.
        """
        state = self._state
        num_skipped = 0 if frame is None else state.num_skipped(frame.stamp)
        with self.clock.stage("total"):
            before = state.box if state.is_valid else None
            finding = self._look(frame)
        age = now - state.box_stamp
        return Extraction(
            **{**vars(finding), "box": state.box},
            before=state.box if before is None else before,
            camera=self._camera,
            is_valid=state.is_valid,
            is_fresh=age <= LARGEST_AGE,
            age=age,
            num_skipped=num_skipped,
        )

    def _look(self, frame: CameraFrame | None) -> Finding:
        """Look at an image, if it is one and a new one."""
        if frame is None:
            return Finding(verdict=Verdict.NO_IMAGE)
        if not frame.stamp > self._state.image_stamp:
            return Finding(verdict=Verdict.REPEATED)
        problem = Verdict.BAD_IMAGE
        try:
            check_image(frame.image, self._camera.width, self._camera.height)
            self._is_checked, problem = True, Verdict.FAILED
            finding = self._find(frame)
        except PerceptionError as error:
            if not self._is_checked:
                raise
            finding = Finding(verdict=problem, message=str(error))
        self._state.image_stamp = frame.stamp
        return finding

    def _find(self, frame: CameraFrame) -> Finding:
        """Find the object in an image of the camera's size."""
        ignored = None
        if self._robot is not None and frame.joint_pos is not None:
            with self.clock.stage("robot"):
                ignored = self._robot.at(frame.joint_pos)
        with self.clock.stage("segment"):
            segmentation = self._segment(frame.image, ignored)
        with self.clock.stage("box"):
            judged = self._judged(segmentation, frame.stamp)
            finding = replace(judged, source=segmentation.source, doubt=segmentation.doubt)
        self._state.count(finding, frame.stamp, ignored)
        return finding

    def _segment(self, image: np.ndarray, ignored: Mask | None) -> Segmentation:
        """Follow the object, or begin to where it is unknown or lost and the prompter knows."""
        state = self._state
        is_lost = state.num_lost >= self._cfg.patience and not state.is_at_robot
        is_asked = is_lost or not state.is_pointed_out
        if not (is_asked or self._segmenter.uses_motion):
            return self._segmenter.track(image)
        motion = self._foreground.step(image, ignored)
        prompt = self._prompter.look(image, motion) if is_asked else None
        if prompt is not None and self._has_begun:
            state.is_pointed_out, state.is_continued, state.num_lost = True, False, 0
            motion = self._foreground.reveal(motion, prompt)
            segmentation = self._segmenter.start(image, prompt, motion)
        else:
            segmentation = self._segmenter.track(image, motion)
        self._foreground.keep(segmentation.mask)
        return segmentation

    def _judged(self, segmentation: Segmentation, stamp: float) -> Finding:
        """The box of a segmentation, unless something speaks against it."""
        state, score, cfg = self._state, segmentation.score, self._cfg.plausibility
        if segmentation.mask is None:
            missing = Verdict.NOT_FOUND if state.is_pointed_out else Verdict.NO_PROMPT
            return Finding(verdict=missing, score=score)
        blobs = find_blobs(segmentation.mask)
        if not blobs:
            return Finding(verdict=Verdict.TOO_SMALL, score=score)
        box = torch.tensor([blobs[0].box])
        verdict = judge(cfg, self._camera, box, blobs[0].area)
        if verdict is not Verdict.SEEN:
            return Finding(verdict=verdict, score=score)
        is_far = state.is_valid and is_jump(cfg, box, state.box, (stamp - state.box_stamp) / CONTROL_DT)
        if is_far and state.is_continued:
            return Finding(verdict=Verdict.JUMP, score=score)
        is_elsewhere = is_far or state.has_jumped
        return Finding(verdict=verdict, score=score, mask=blobs[0].mask(), box=box, is_elsewhere=is_elsewhere)
