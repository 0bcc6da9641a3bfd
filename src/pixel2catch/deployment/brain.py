"""What happens in a control step between the newest image and the servo: perception, then the policy."""

from dataclasses import dataclass

import numpy as np
import torch

from pixel2catch.deployment.controller import Controller
from pixel2catch.deployment.motion import Joints
from pixel2catch.deployment.servo_link import Orders
from pixel2catch.errors import NonFiniteError
from pixel2catch.perception.extractor import Extraction, PixelFeatureExtractor
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.perception.prompt import GivenPrompter
from pixel2catch.perception.segmenter import Prompt


@dataclass(frozen=True, kw_only=True)
class Thought:
    """What became of one control step.

    Attributes:
        extraction: What was seen.
        orders: For the servo; none before the object is seen, nor without joint positions.
        message: What is wrong; empty if nothing is.
    """

    extraction: Extraction
    orders: Orders | None
    message: str


class Brain:
    """Perception and policy, without a network and without a clock.

    Args:
        controller: The policy.
        extractor: The perception.
        person: What tells the extractor's prompter where the operator points.
    """

    def __init__(
        self, controller: Controller, extractor: PixelFeatureExtractor, person: GivenPrompter
    ) -> None:
        """Begin before the first throw."""
        self._controller, self._extractor, self._person = controller, extractor, person

    def begin(self, prompt: Prompt | None = None) -> None:
        """A new throw begins: nothing is known of the object but where the operator points."""
        self._extractor.reset()
        self._controller.reset()
        if prompt is not None:
            self._person.give(prompt)

    def think(self, frame: CameraFrame | None, joint_pos: Joints, now: float) -> Thought:
        """Go one control step on.

        Args:
            frame: The newest image, be it the same as before; none before the first.
            joint_pos: Newest joint positions, in joint order [rad]; NaN where unknown.
            now: The time [s], of the clock of the image's stamp.

        Raises:
            PerceptionError: The first image has the wrong size.
        """
        seen = self._extractor.step(frame, now)
        if frame is None or not seen.is_valid or np.isnan(joint_pos).any():
            return Thought(extraction=seen, orders=None, message=seen.message)
        try:
            target = self._controller.step(torch.tensor(joint_pos[None], dtype=torch.float32), seen.box)
        except NonFiniteError as error:
            return Thought(extraction=seen, orders=None, message=str(error))
        orders = Orders(
            joint_pos_target=target[0].double().numpy(), target_stamp=now, image_stamp=frame.stamp
        )
        return Thought(extraction=seen, orders=orders, message=seen.message)
