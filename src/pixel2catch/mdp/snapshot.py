"""One control step as data: what the robot measures, what only the simulator has, and what changed.

Policies observe a `Measurement` alone; value networks and rewards may also use `Privileged`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.mdp.tensors import select
from pixel2catch.robots.geometry import WorkcellGeometry
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
        """Return the history of an object at rest: one box [px] in every control step before `age`."""
        steps = torch.arange(num_boxes, device=age.device, dtype=age.dtype)
        return cls(box=box[:, None].expand(-1, num_boxes, -1).clone(), age=age[:, None] + steps)

    @classmethod
    def of_stamps(
        cls, boxes: Float[Tensor, "num_measured 4"], stamps: Sequence[float], now: float, num_boxes: int
    ) -> "BoxHistory":
        """Return the history of one robot from images with stamps; before the first, the object was at rest.

        Args:
            boxes: Measured boxes, oldest first, at least one [px].
            stamps: When their images were taken [s].
            now: The time [s].
            num_boxes: Length of the history.
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
        """Return the history a control step later, with the delivered box [px] where it is new."""
        older = BoxHistory(box=self.box, age=self.age + 1.0)
        newest = BoxHistory(
            box=torch.cat((box[:, None], older.box[:, :-1]), dim=1),
            age=torch.cat((age[:, None], older.age[:, :-1]), dim=1),
        )
        return select(is_new, newest, older)


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What the robot measures at one control step, in simulation and in the laboratory."""

    boxes: BoxHistory  #: The last measured boxes of the object.
    #: Position of the object's centre by a tracker, as old as the box, world frame [m]; for comparisons.
    object_pos: Float[Tensor, "num_envs 3"]
    initial_object_pos: Float[Tensor, "num_envs 3"]  #: The first such position of the episode [m].
    joint_pos: Float[Tensor, "num_envs num_joints"]  #: Joint encoders [rad].
    joint_pos_target: Float[Tensor, "num_envs num_joints"]  #: Joint targets commanded at this step [rad].
    #: Positions of the palms by forward kinematics of `joint_pos`, world frame [m].
    palm_pos: Float[Tensor, "num_envs num_palms 3"]
    #: Their orientations likewise, (w, x, y, z), with the sign of `robots.chain`.
    palm_quat: Float[Tensor, "num_envs num_palms 4"]
    action: Float[Tensor, "num_envs num_joints"]  #: Last actions of all agents in joint order, in [-1, 1].

    @property
    def box(self) -> Float[Tensor, "num_envs 4"]:
        """Return the newest measured box of the object: xmin, ymin, xmax, ymax [px]."""
        return self.boxes.box[:, 0]


class History(NamedTuple):
    """Three consecutive measurements: two frames, each with a difference to the step before it."""

    oldest: Measurement
    before: Measurement
    now: Measurement


@dataclass(frozen=True, kw_only=True)
class Privileged:
    """The true state at one control step, which only a simulator has (world frame)."""

    palm_pos: Float[Tensor, "num_envs num_palms 3"]  #: True positions of the palms [m].
    palm_normal: Float[Tensor, "num_envs num_palms 3"]  #: Their normals, unit vectors.
    #: True positions of the fingertips, palm by palm [m].
    fingertip_pos: Float[Tensor, "num_envs num_fingers 3"]
    object_pos: Float[Tensor, "num_envs 3"]  #: Position of the object's centre [m].
    object_lin_vel: Float[Tensor, "num_envs 3"]  #: Its velocity [m/s].
    object_reach: Float[Tensor, " num_envs"]  #: Distance from a palm under which it counts as reached [m].
    #: Which palms and fingers touched the object since the step before: each palm, then its fingers.
    is_touching: Bool[Tensor, "num_envs num_parts"]
    is_robot_on_table: Bool[Tensor, " num_envs"]  #: Whether a robot touched the table since the step before.
    #: Whether a robot touched itself, or another one, since the step before.
    is_self_contact: Bool[Tensor, " num_envs"]
    is_robot_contact: Bool[Tensor, " num_envs"]  #: Whether it touched another one since the step before.
    joint_vel: Float[Tensor, "num_envs num_joints"]  #: Joint speeds [rad/s].


@dataclass(frozen=True, kw_only=True)
class Transition:
    """What one control step changed: the input of every reward and ending."""

    before: Privileged  #: The state before the action.
    now: Privileged  #: The state after it.
    action: Float[Tensor, "num_envs num_joints"]  #: The actions in joint order, in [-1, 1].
    joint_pos_target: Float[Tensor, "num_envs num_joints"]  #: The commanded joint targets [rad].
    #: Consecutive control steps, this one included, with the object in the palm's reach.
    held_steps: Int[Tensor, " num_envs"]
    was_success: Bool[Tensor, " num_envs"]  #: Whether there was a success in an earlier step of the episode.
    #: Control steps since the start of the episode, this one included.
    episode_steps: Int[Tensor, " num_envs"]
    geometry: WorkcellGeometry  #: Forward kinematics of palms and arms.
