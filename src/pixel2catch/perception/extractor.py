"""Images to pixel features, once in every control step: what training got from `envs.eye`, from a camera.

Box and features are computed by the functions of training: `camera.boxes` and `camera.features`.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.camera.boxes import hold_box
from pixel2catch.camera.features import pixel_features
from pixel2catch.errors import PerceptionError
from pixel2catch.perception.finder import CameraFrame, FinderCfg, Finding, ObjectFinder
from pixel2catch.perception.gate import Verdict
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Mask, Segmenter, check_image
from pixel2catch.perception.stages import StageClock
from pixel2catch.robot.constants import CONTROL_DT, RGB_CAMERA, CameraSpec

LARGEST_AGE = 2.5 * CONTROL_DT
"""Age up to which a box is fresh [s]. Source: release; in training boxes are one or two steps old."""


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
class _Sight:
    """What is known of the throw so far.

    Attributes:
        box: The last accepted box [px].
        box_stamp: When its image was taken [s].
        image_stamp: When the last image was taken that was looked at [s].
    """

    box: Float[Tensor, "1 4"] = field(default_factory=lambda: torch.zeros(1, 4))
    box_stamp: float = -torch.inf
    image_stamp: float = -torch.inf

    @property
    def is_valid(self) -> bool:
        """Whether the object was ever seen."""
        return self.box_stamp > -torch.inf

    def num_skipped(self, stamp: float) -> int:
        """Control steps without an image between the last image and this one."""
        if self.image_stamp == -torch.inf or not stamp > self.image_stamp:
            return 0
        return max(round((stamp - self.image_stamp) / CONTROL_DT) - 1, 0)


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
        cfg: FinderCfg | None = None,
    ) -> None:
        """Begin before the first throw.

        Args:
            segmenter: What finds the object's pixels.
            prompter: What says which thing is the object.
            robot: The robot, whose motion is not the object's; None where that does no harm.
            camera: The camera, for the size of the image.
            cfg: When a box counts.
        """
        self.clock = StageClock()
        self._finder = ObjectFinder(segmenter, prompter, robot=robot, cfg=cfg or FinderCfg())
        self._camera = camera
        self._sight = _Sight()
        self._is_checked = False

    def reset(self) -> None:
        """Begin a new throw, whose stamps may begin anew; what is known of the background stays."""
        self._finder.reset()
        self._sight = _Sight()

    def step(self, frame: CameraFrame | None, now: float) -> Extraction:
        """Process the newest image; call it once in every control step.

        Args:
            frame: The newest image, be it the same as in the step before; None if there is none yet.
            now: The time [s], of the clock of the stamps.

        Raises:
            PerceptionError: If the very first image has the wrong size or encoding; later such an image is
                passed over.
        """
        with self.clock.stage("total"):
            finding, before = self._find(frame), self._sight
            with self.clock.stage("features"):
                self._sight = _advanced(before, frame, finding)
                first = before.box if before.is_valid else self._sight.box
                features = pixel_features(first, self._sight.box, self._camera)
        age = now - self._sight.box_stamp
        return Extraction(
            box=self._sight.box,
            features=features,
            verdict=finding.verdict,
            is_valid=self._sight.is_valid,
            is_fresh=age <= LARGEST_AGE,
            age=age,
            score=finding.score,
            num_skipped=0 if frame is None else before.num_skipped(frame.stamp),
            mask=finding.mask,
            message=finding.message,
        )

    def _find(self, frame: CameraFrame | None) -> Finding:
        """Look at an image, if it is one and a new one."""
        if frame is None:
            return Finding(verdict=Verdict.NO_IMAGE)
        if not frame.stamp > self._sight.image_stamp:
            return Finding(verdict=Verdict.REPEATED)
        try:
            check_image(frame.image, self._camera.width, self._camera.height)
        except PerceptionError as error:
            if self._is_checked:
                return Finding(verdict=Verdict.BAD_IMAGE, message=str(error))
            raise
        self._is_checked = True
        try:
            return self._finder.find(frame, self._camera, self.clock)
        except PerceptionError as error:
            return Finding(verdict=Verdict.FAILED, message=str(error))


def _advanced(sight: _Sight, frame: CameraFrame | None, finding: Finding) -> _Sight:
    """What is known after an image: where the object was not seen, the box is held."""
    if frame is None or not frame.stamp > sight.image_stamp:
        return sight
    is_seen = finding.verdict is Verdict.SEEN
    return _Sight(
        box=hold_box(finding.box, torch.tensor([is_seen]), sight.box),
        box_stamp=frame.stamp if is_seen else sight.box_stamp,
        image_stamp=frame.stamp,
    )
