"""One image to one box, or the reason why there is none: prompt, segment, take the largest region, judge."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.camera.boxes import box_of_mask
from pixel2catch.perception.blobs import largest_component
from pixel2catch.perception.gate import Before, GateCfg, Verdict, judge
from pixel2catch.perception.prompt import Prompter
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Mask, Segmentation, Segmenter
from pixel2catch.perception.stages import StageClock
from pixel2catch.robot.constants import CONTROL_DT, CameraSpec


@dataclass(frozen=True, kw_only=True)
class CameraFrame:
    """One image of the camera; whether it is one is checked by whoever gets it.

    Attributes:
        image: Red, green, blue; upper row first.
        stamp: When it was taken [s].
        joint_pos: Positions of arm and hand at that time, in joint order [rad]; None if unknown.
    """

    image: np.ndarray
    stamp: float
    joint_pos: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class FinderCfg:
    """When a box counts, and when the object is lost.

    Attributes:
        gate: Limits of the plausible.
        patience: Images without an accepted box after which the prompter is asked again. Source: ours.
    """

    gate: GateCfg = field(default_factory=GateCfg)
    patience: int = 5


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What became of one image.

    Attributes:
        verdict: Whether the object was seen, or why not.
        score: The segmenter's score, on its own scale; 0 where it was not asked.
        mask: The object's pixels, where it was seen.
        box: The box around them [px]; zeros where it was not seen.
        message: What went wrong with an image that could not be used.
    """

    verdict: Verdict
    score: float = 0.0
    mask: Mask | None = None
    box: Float[Tensor, "1 4"] = field(default_factory=lambda: torch.zeros(1, 4))
    message: str = ""


class ObjectFinder:
    """Finds one object in a stream of images.

    What vanished at the robot is taken to be in its hand: then nothing else is looked for, and only the
    segmenter can find it again.
    """

    def __init__(
        self, segmenter: Segmenter, prompter: Prompter, *, robot: RobotMask | None, cfg: FinderCfg
    ) -> None:
        """Begin before the first throw.

        Args:
            segmenter: What finds the object's pixels.
            prompter: What says which thing is the object.
            robot: The robot, whose motion is not the object's; None where that does no harm.
            cfg: When a box counts.
        """
        self._segmenter, self._prompter, self._robot, self._cfg = segmenter, prompter, robot, cfg
        self._forget()

    def reset(self) -> None:
        """Begin a new throw; what is known of the background stays."""
        self._segmenter.reset()
        self._prompter.reset()
        self._forget()

    def find(self, frame: CameraFrame, camera: CameraSpec, clock: StageClock) -> Finding:
        """Find the object in the next image.

        Args:
            frame: An image of the camera's size.
            camera: The camera.
            clock: Measures the stages.

        Raises:
            PerceptionError: If the robot's state or the segmenter cannot be used.
        """
        ignored = None
        if self._robot is not None and frame.joint_pos is not None:
            with clock.stage("robot"):
                ignored = self._robot.at(frame.joint_pos)
        with clock.stage("segment"):
            segmentation = self._segment(frame.image, ignored)
        with clock.stage("box"):
            finding = self._judged(segmentation, frame.stamp, camera)
        if finding.verdict is Verdict.SEEN:
            self._before, self._num_lost = (finding.box, frame.stamp), 0
            self._is_at_robot = ignored is not None and _touches(finding.box, ignored)
        else:
            self._num_lost += 1
        return finding

    def _forget(self) -> None:
        """Know nothing of the object."""
        self._before: tuple[Float[Tensor, "1 4"], float] | None = None
        self._is_pointed_out = self._is_at_robot = False
        self._num_lost = 0

    def _segment(self, image: np.ndarray, ignored: Mask | None) -> Segmentation:
        """Follow the object, or begin to where it is unknown or lost and the prompter knows."""
        is_lost = self._num_lost >= self._cfg.patience and not self._is_at_robot
        if is_lost or not self._is_pointed_out:
            prompt = self._prompter.look(image, ignored)
            if prompt is not None:
                self._before, self._is_pointed_out, self._num_lost = None, True, 0
                return self._segmenter.start(image, prompt, ignored)
        return self._segmenter.track(image, ignored)

    def _judged(self, segmentation: Segmentation, stamp: float, camera: CameraSpec) -> Finding:
        """The box of a segmentation, unless something speaks against it."""
        score = segmentation.score
        if segmentation.mask is None:
            missing = Verdict.NOT_FOUND if self._is_pointed_out else Verdict.NO_PROMPT
            return Finding(verdict=missing, score=score)
        mask = largest_component(segmentation.mask)
        box, _ = box_of_mask(torch.from_numpy(mask)[None])
        before = None
        if self._before is not None:
            before = Before(box=self._before[0], steps=(stamp - self._before[1]) / CONTROL_DT)
        verdict = judge(self._cfg.gate, camera, box, int(mask.sum()), before)
        if verdict is not Verdict.SEEN:
            return Finding(verdict=verdict, score=score)
        return Finding(verdict=verdict, score=score, mask=mask, box=box)


def _touches(box: Float[Tensor, "1 4"], mask: Mask) -> bool:
    """Return whether a box [px] holds a pixel of a mask."""
    xmin, ymin, xmax, ymax = (int(edge) for edge in box[0])
    return bool(mask[ymin:ymax, xmin:xmax].any())
