"""The last measured boxes of the object and their ages: what a policy may remember of the images."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.mdp.masks import select
from pixel2catch.scene.constants import CONTROL_DT


@dataclass(frozen=True, kw_only=True)
class BoxHistory:
    """Measured boxes, the newest first; an image in which nothing was found adds none."""

    box: Float[Tensor, "num_envs num_boxes 4"]  #: xmin, ymin, xmax, ymax [px].
    #: Time since the exposure of each image, by its stamp [control steps].
    age: Float[Tensor, "num_envs num_boxes"]

    @classmethod
    def begun(
        cls, box: Float[Tensor, "num_envs 4"], age: Float[Tensor, " num_envs"], num_boxes: int
    ) -> "BoxHistory":
        """The history of an object that has been where it is for long: one box, once in every control step.

        `box` is in pixels, `age` in control steps.
        """
        steps = torch.arange(num_boxes, device=age.device, dtype=age.dtype)
        return cls(box=box[:, None].expand(-1, num_boxes, -1).clone(), age=age[:, None] + steps)

    @classmethod
    def of_stamps(
        cls, boxes: Float[Tensor, "num_measured 4"], stamps: Sequence[float], now: float, num_boxes: int
    ) -> "BoxHistory":
        """The history of one robot, from images with stamps; before the first one the object was there, too.

        Args:
            boxes: Measured boxes, oldest first, at least one [px].
            stamps: When their images were taken [s].
            now: The time [s].
            num_boxes: Boxes to remember.
        """
        ages = torch.tensor([(now - stamp) / CONTROL_DT for stamp in stamps], dtype=torch.float32).flip(0)
        newest = boxes.flip(0)
        history = cls.begun(newest[-1:], ages[-1:], num_boxes)
        box = torch.cat((newest[:-1], history.box[0]))[:num_boxes]
        age = torch.cat((ages[:-1], history.age[0]))[:num_boxes]
        return cls(box=box[None], age=age[None])

    def advanced(
        self,
        box: Float[Tensor, "num_envs 4"],
        age: Float[Tensor, " num_envs"],
        is_new: Bool[Tensor, " num_envs"],
    ) -> "BoxHistory":
        """The history a control step later; the delivered box [px], of this age, may be an old one."""
        older = BoxHistory(box=self.box, age=self.age + 1.0)
        newest = BoxHistory(
            box=torch.cat((box[:, None], older.box[:, :-1]), dim=1),
            age=torch.cat((age[:, None], older.age[:, :-1]), dim=1),
        )
        return select(is_new, newest, older)
