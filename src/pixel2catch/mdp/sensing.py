"""What stands between the true state and a `Measurement`: occlusion, corner noise, latency, encoder noise.

Training and evaluation in simulation only: on the robot the sensors themselves do this.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.camera.boxes import box_of_points, hold_box
from pixel2catch.camera.pinhole import project
from pixel2catch.camera.visibility import is_in_view
from pixel2catch.mdp.masks import select
from pixel2catch.robot.constants import RGB_CAMERA


@dataclass(frozen=True, kw_only=True)
class SensingCfg:
    """Noise and delay of the sensors.

    Attributes:
        corner_noise: Largest error of each edge of the box, uniform [px] (Source: paper).
        latency_steps: Control steps between image and delivered box, first and last of the draw per episode
            (Source: release).
        joint_noise: Standard deviation of the encoders' noise [rad] (Source: paper, Table I, observation
            noise).
        joint_bias: Standard deviation of their error in an episode [rad] (Source: release).
        least_visible: Share of the object's surface points that must be visible for a detection (Source:
            ours, see `benchmarks/box_error.py`).
    """

    corner_noise: float = 5.0
    latency_steps: tuple[int, int] = (1, 2)
    joint_noise: float = 0.005
    joint_bias: float = 0.001
    least_visible: float = 0.05


@dataclass(frozen=True, kw_only=True)
class Detection:
    """What is known of the object from one image.

    Attributes:
        box: Its bounding box [px].
        object_pos: Its position by a tracker, world frame [m].
    """

    box: Float[Tensor, "num_envs 4"]
    object_pos: Float[Tensor, "num_envs 3"]

    def held(self, is_seen: Bool[Tensor, " num_envs"], previous: "Detection") -> "Detection":
        """This detection where the object is seen, else the previous one."""
        box = hold_box(self.box, is_seen, previous.box)
        object_pos = torch.where(is_seen[:, None], self.object_pos, previous.object_pos)
        return Detection(box=box, object_pos=object_pos)


@dataclass(frozen=True)
class DetectionStream:
    """Detections on their way to the policy: the newest and its predecessors.

    Attributes:
        ages: Detections by age in control steps, newest first.
    """

    ages: tuple[Detection, ...]

    def delivered(self, latency: Int[Tensor, " num_envs"]) -> Detection:
        """The detection that is `latency` control steps old."""
        result = self.ages[0]
        for age, detection in enumerate(self.ages[1:], start=1):
            result = select(latency >= age, detection, result)
        return result

    def pushed(self, detection: Detection) -> "DetectionStream":
        """The stream one control step later."""
        return DetectionStream((detection, *self.ages[:-1]))

    @classmethod
    def filled(cls, detection: Detection, num_ages: int) -> "DetectionStream":
        """A stream in which every age is the same: how an episode begins."""
        return cls((detection,) * num_ages)

    @property
    def newest(self) -> Detection:
        """The last detection."""
        return self.ages[0]


def detect(
    points: Float[Tensor, "num_envs num_points 3"],
    is_visible: Bool[Tensor, "num_envs num_points"],
    least_visible: float,
) -> tuple[Float[Tensor, "num_envs 4"], Bool[Tensor, " num_envs"]]:
    """Box of the visible surface points, and whether enough of them are visible for a detection.

    Args:
        points: Surface points of the object, world frame [m].
        is_visible: Which of them nothing hides.
        least_visible: Share that must be visible and in the image.
    """
    pixels, depth = project(RGB_CAMERA, points)
    in_view = is_in_view(RGB_CAMERA, pixels, depth)
    is_seen = (is_visible & in_view).to(points.dtype).mean(dim=-1) >= least_visible
    return box_of_points(pixels, is_visible, RGB_CAMERA), is_seen
