"""Images to pixel features, once in every control step: as `envs.detector` gives training, of a camera.

An image goes through the segmenter to a mask, its largest region to a box, and a plausible box to features.
Box and features are computed by the functions of training, `camera.boxes`.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.camera.boxes import box_of_mask, pixel_features
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.image_track import largest_component
from pixel2catch.perception.plausibility import PlausibilityCfg, Verdict, judge
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Mask, Segmentation, Segmenter, check_image
from pixel2catch.perception.timing import StageClock
from pixel2catch.scene.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

LARGEST_AGE = 2.5 * CONTROL_DT
"""Age up to which a box is fresh [s]. Source: release; in training boxes are one or two steps old."""


@dataclass(frozen=True, kw_only=True)
class CameraFrame:
    """One image of the camera; whether it is one is checked by whoever gets it.

    Attributes:
        image: Red, green, blue; upper row first.
        stamp: When it was taken [s].
        joint_pos: Positions of the robot's joints at that time, in joint order [rad]; None if unknown.
    """

    image: np.ndarray
    stamp: float
    joint_pos: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class ExtractorCfg:
    """When a box counts, and after how many images without one the prompter is asked again. Source: ours."""

    plausibility: PlausibilityCfg = field(default_factory=PlausibilityCfg)
    patience: int = 5


@dataclass(frozen=True, kw_only=True)
class Extraction:
    """What a control step knows of the object: the box for the policy, the rest for log and safety.

    Attributes:
        box: What `Measurement.box` is in training [px]; zeros before the first detection.
        features: The features of this box and that of the step before, for show; the first box of a throw
            stands for its predecessor, as at the beginning of an episode.
        verdict: What became of the image; only `SEEN` gives a new box.
        is_valid: Whether the object was seen in this throw.
        is_fresh: Whether the box is no older than those of training.
        age: Time since the image of the box [s]; infinite before the first detection.
        score: The segmenter's score of this image, on its own scale; 0 where it was not asked.
        num_skipped: Control steps since the image before that had none: so many too many are in the
            differences.
        mask: The object's pixels, where it was seen.
        message: What went wrong with an image that could not be used.
    """

    box: Float[Tensor, "1 4"]
    features: Float[Tensor, "1 8"]
    verdict: Verdict
    is_valid: bool
    is_fresh: bool
    age: float
    score: float
    num_skipped: int
    mask: Mask | None
    message: str


@dataclass(frozen=True, kw_only=True)
class _Finding:
    """What became of one image: fields of `Extraction`."""

    verdict: Verdict
    score: float = 0.0
    mask: Mask | None = None
    box: Float[Tensor, "1 4"] | None = None
    message: str = ""


@dataclass(kw_only=True)
class TrackState:
    """What is known of the object in this throw.

    Attributes:
        box: The box that was last accepted [px].
        box_stamp: When its image was taken [s].
        image_stamp: When the last image was taken that was looked at [s].
        num_lost: Images since that box, or since the object was pointed out.
        is_pointed_out: Whether the segmenter was told what the object is.
        is_continued: Whether the box is one of the thing that was last pointed out.
        is_at_robot: Whether the box touched the robot. What vanished there is taken to be in its hand: then
            nothing else is looked for, and only the segmenter can find it again.
    """

    box: Float[Tensor, "1 4"] = field(default_factory=lambda: torch.zeros(1, 4))
    box_stamp: float = -torch.inf
    image_stamp: float = -torch.inf
    num_lost: int = 0
    is_pointed_out: bool = False
    is_continued: bool = False
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

    def count(self, finding: _Finding, stamp: float, ignored: Mask | None) -> None:
        """Take over what was found in an image of this time; where nothing was, the box is held."""
        if finding.box is None:
            self.num_lost += 1
            return
        self.box, self.box_stamp = finding.box, stamp
        self.num_lost, self.is_continued = 0, True
        xmin, ymin, xmax, ymax = (int(edge) for edge in finding.box[0])
        self.is_at_robot = ignored is not None and bool(ignored[ymin:ymax, xmin:xmax].any())


class PixelFeatureExtractor:
    """Makes boxes and features of a stream of images; an image of a wrong kind is refused once, at the start.

    Attributes:
        clock: How long each stage took.
    """

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

        Args:
            segmenter: What finds the object's pixels.
            prompter: What says which thing is the object.
            robot: The robot, whose motion is not the object's; None where that does no harm.
            camera: The camera, for the size of the image.
            cfg: When a box counts.
            waits: Look for no object, and only learn, before the first throw begins with a reset.
        """
        self.clock = StageClock()
        self._segmenter, self._prompter, self._robot = segmenter, prompter, robot
        self._camera, self._cfg = camera, cfg or ExtractorCfg()
        self._state = TrackState()
        self._is_checked, self._has_begun = False, not waits

    def reset(self) -> None:
        """Begin a new throw, whose stamps may begin anew; what is known of the background stays."""
        self._segmenter.reset()
        self._prompter.reset()
        self._state, self._has_begun = TrackState(), True

    def step(self, frame: CameraFrame | None, now: float) -> Extraction:
        """Process the newest image; call it once in every control step.

        Args:
            frame: The newest image, be it the same as in the step before; None if there is none yet.
            now: The time [s], of the clock of the stamps.

        Raises:
            PerceptionError: If the very first image has the wrong size or encoding; later such an image is
                passed over.
        """
        state = self._state
        num_skipped = 0 if frame is None else state.num_skipped(frame.stamp)
        with self.clock.stage("total"):
            before = state.box if state.is_valid else None
            finding = self._look(frame)
            with self.clock.stage("features"):
                features = pixel_features(state.box if before is None else before, state.box, self._camera)
        age = now - state.box_stamp
        return Extraction(
            box=state.box,
            features=features,
            verdict=finding.verdict,
            is_valid=state.is_valid,
            is_fresh=age <= LARGEST_AGE,
            age=age,
            score=finding.score,
            num_skipped=num_skipped,
            mask=finding.mask,
            message=finding.message,
        )

    def _look(self, frame: CameraFrame | None) -> _Finding:
        """Look at an image, if it is one and a new one."""
        if frame is None:
            return _Finding(verdict=Verdict.NO_IMAGE)
        if not frame.stamp > self._state.image_stamp:
            return _Finding(verdict=Verdict.REPEATED)
        problem = Verdict.BAD_IMAGE
        try:
            check_image(frame.image, self._camera.width, self._camera.height)
            self._is_checked, problem = True, Verdict.FAILED
            finding = self._find(frame)
        except PerceptionError as error:
            if not self._is_checked:
                raise
            finding = _Finding(verdict=problem, message=str(error))
        self._state.image_stamp = frame.stamp
        return finding

    def _find(self, frame: CameraFrame) -> _Finding:
        """Find the object in an image of the camera's size."""
        ignored = None
        if self._robot is not None and frame.joint_pos is not None:
            with self.clock.stage("robot"):
                ignored = self._robot.at(frame.joint_pos)
        with self.clock.stage("segment"):
            segmentation = self._segment(frame.image, ignored)
        with self.clock.stage("box"):
            finding = self._judged(segmentation, frame.stamp)
        self._state.count(finding, frame.stamp, ignored)
        return finding

    def _segment(self, image: np.ndarray, ignored: Mask | None) -> Segmentation:
        """Follow the object, or begin to where it is unknown or lost and the prompter knows."""
        state = self._state
        is_lost = state.num_lost >= self._cfg.patience and not state.is_at_robot
        if is_lost or not state.is_pointed_out:
            prompt = self._prompter.look(image, ignored)
            if prompt is not None and self._has_begun:
                state.is_pointed_out, state.is_continued, state.num_lost = True, False, 0
                return self._segmenter.start(image, prompt, ignored)
        return self._segmenter.track(image, ignored)

    def _judged(self, segmentation: Segmentation, stamp: float) -> _Finding:
        """The box of a segmentation, unless something speaks against it."""
        state, score = self._state, segmentation.score
        if segmentation.mask is None:
            missing = Verdict.NOT_FOUND if state.is_pointed_out else Verdict.NO_PROMPT
            return _Finding(verdict=missing, score=score)
        mask = largest_component(segmentation.mask)
        box, _ = box_of_mask(torch.from_numpy(mask)[None])
        before = state.box if state.is_continued else None
        steps = (stamp - state.box_stamp) / CONTROL_DT
        verdict = judge(self._cfg.plausibility, self._camera, box, int(mask.sum()), before, steps)
        if verdict is not Verdict.SEEN:
            return _Finding(verdict=verdict, score=score)
        return _Finding(verdict=verdict, score=score, mask=mask, box=box)
