"""What happens in a control step between the newest image and the servo: perception, then the policy."""

from collections import deque

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pixel2catch.deployment.controller import Controller
from pixel2catch.deployment.motion import Joints
from pixel2catch.deployment.servo_link import Orders
from pixel2catch.perception.extractor import Extraction, PixelFeatureExtractor
from pixel2catch.perception.finder import CameraFrame
from pixel2catch.perception.prompt import FirstPrompter, GivenPrompter, Prompter
from pixel2catch.perception.robot_mask import RobotMask
from pixel2catch.perception.segmenter import Prompt, Segmenter
from pixel2catch.perception.tracking import LaterPrompter
from pixel2catch.robot.constants import CONTROL_DT, CameraSpec

BOX_AGE = 1.8 * CONTROL_DT
"""How old the boxes are that the policy gets, if images are not older [s]. Source: ours.

In training they are one or two control steps old. The policy leads the object by so much, and reaches beyond
it where boxes are younger: in simulation `proposed` catches 92 % of 200 throws with boxes one control step
old, 94 % with two, and 76 % with none. The same age in every step matters, too: with the box that is nearest
to an age, which is now of this image and now of the one before, it catches 69 % instead of 89 % of 150 throws
where perception takes 10 to 17 ms by chance.
"""

MEMORY = 8
"""Boxes that are kept, one an image."""


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
        self._stamps: deque[float] = deque(maxlen=MEMORY)
        self._boxes: deque[Float[Tensor, " 4"]] = deque(maxlen=MEMORY)

    def begin(self, prompt: Prompt | None = None) -> None:
        """A new throw begins: nothing is known of the object but where the operator points."""
        self._extractor.reset()
        self._controller.reset()
        self._stamps.clear()
        self._boxes.clear()
        if prompt is not None:
            self._person.give(prompt)

    def see(self, frame: CameraFrame | None, now: float) -> Extraction:
        """Look at the newest image: the longer half of a control step.

        Args:
            frame: The newest image, be it the same as before; none before the first.
            now: The time [s], of the clock of the image's stamp.

        Raises:
            PerceptionError: The first image has the wrong size.
        """
        seen = self._extractor.step(frame, now)
        if frame and seen.is_valid and (not self._stamps or frame.stamp > self._stamps[-1]):
            self._stamps.append(frame.stamp)
            self._boxes.append(seen.box[0])
        return seen

    def decide(self, joint_pos: Joints, now: float) -> Orders | None:
        """Let the policy decide on what was seen, and on joints as they are now.

        In training it acts in the very moment in which the joints are measured. Positions that are as old as
        the perception takes cost `proposed` 5 of 100 throws (experiments/LOG.md).

        Args:
            joint_pos: Newest joint positions, in joint order [rad]; NaN where unknown.
            now: The time [s].

        Returns:
            Orders for the servo; none before the object is seen, nor without joint positions.

        Raises:
            NonFiniteError: A joint position is infinite.
        """
        if not self._boxes or np.isnan(joint_pos).any():
            return None
        target = self._controller.step(
            torch.tensor(joint_pos[None], dtype=torch.float32), self._box_at(now - BOX_AGE)
        )
        return Orders(
            joint_pos_target=target[0].double().numpy(), target_stamp=now, image_stamp=self._stamps[-1]
        )

    def _box_at(self, moment: float) -> Float[Tensor, "1 4"]:
        """Where the object was [px], between two images or in the newest one that is not newer [s]."""
        edges = np.transpose([box.numpy() for box in self._boxes])
        box = [np.interp(moment, self._stamps, edge) for edge in edges]
        return torch.tensor([box], dtype=torch.float32)


def make_brain(
    controller: Controller,
    segmenter: Segmenter,
    prompter: Prompter,
    camera: CameraSpec,
    robot: RobotMask | None,
) -> Brain:
    """Put perception and policy together.

    Args:
        controller: The policy.
        segmenter: What finds the object.
        prompter: What points it out where the operator does not.
        camera: The camera.
        robot: The robot, whose motion is not the object's; None where that does no harm.
    """
    person = GivenPrompter()
    either = LaterPrompter(FirstPrompter(person, prompter))
    return Brain(controller, PixelFeatureExtractor(segmenter, either, robot=robot, camera=camera), person)
