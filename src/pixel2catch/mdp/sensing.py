"""What stands between the true state and a `Measurement`: occlusion, corner noise, latency, encoder noise.

Training and evaluation in simulation only: on the robot the sensors themselves do this.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.camera.boxes import box_of_points
from pixel2catch.camera.pinhole import project
from pixel2catch.camera.visibility import is_in_view
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


@dataclass(frozen=True)
class BoxStream:
    """Detected boxes on their way to the policy: the newest and its predecessors.

    Attributes:
        boxes: Boxes by age in control steps, newest first [px].
    """

    boxes: Float[Tensor, "num_envs num_ages 4"]

    def delivered(self, latency: Int[Tensor, " num_envs"]) -> Float[Tensor, "num_envs 4"]:
        """The box that is `latency` control steps old."""
        index = latency.view(-1, 1, 1).expand(-1, 1, 4)
        return self.boxes.gather(1, index).squeeze(1)

    def pushed(self, box: Float[Tensor, "num_envs 4"]) -> "BoxStream":
        """The stream one control step later."""
        return BoxStream(torch.cat((box[:, None], self.boxes[:, :-1]), dim=1))

    def filled(self, box: Float[Tensor, "num_envs 4"]) -> "BoxStream":
        """A stream in which every age is `box`: how an episode begins."""
        return BoxStream(box[:, None].expand_as(self.boxes))

    @property
    def newest(self) -> Float[Tensor, "num_envs 4"]:
        """The last detected box."""
        return self.boxes[:, 0]


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
