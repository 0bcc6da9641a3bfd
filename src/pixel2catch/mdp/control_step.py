"""One control step as data: measurements, actions, what only the simulator has, and what changed.

Policies observe a `Measurement` alone; value networks and rewards may also use `Privileged`. One affine map
turns the actions in [-1, 1] of all joints into joint position targets. An arm's scaled action is added to the
measured joint position; a hand's, rescaled to the joint limits, is the target. Source: paper, Sec. IV-D.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from pixel2catch.batches import Boxes, Counts, Flags, Joints, Scalars, Vectors
from pixel2catch.mdp.tensors import select
from pixel2catch.robots.geometry import WorkcellGeometry
from pixel2catch.robots.spec import JointSpec
from pixel2catch.scene.constants import CONTROL_DT

Columns = tuple[slice, ...]
"""Columns of a tensor as slices; an index tensor would have to be copied to the device."""


@dataclass(frozen=True, kw_only=True)
class BoxHistory:
    """Measured boxes, the newest first; an image in which nothing was found adds none."""

    box: Float[Tensor, "num_envs num_boxes 4"]  #: xmin, ymin, xmax, ymax [px].
    age: Float[Tensor, "num_envs num_boxes"]  #: Time since the exposure, by stamp [control steps].

    @classmethod
    def begun(cls, box: Boxes, age: Scalars, num_boxes: int) -> "BoxHistory":
        """Return the history of an object at rest: the same box [px], of age `age`, `age + 1`, and so on."""
        steps = torch.arange(num_boxes, device=age.device, dtype=age.dtype)
        return cls(box=box[:, None].expand(-1, num_boxes, -1).clone(), age=age[:, None] + steps)

    @classmethod
    def of_stamps(
        cls, boxes: Float[Tensor, "num_measured 4"], stamps: Sequence[float], now: float, num_boxes: int
    ) -> "BoxHistory":
        """Return the history of one robot from images with stamps; before the first, the object was at rest.

        One or more boxes are given [px], oldest first, with the times of their images and the present [s].
        """
        ages = torch.tensor([(now - stamp) / CONTROL_DT for stamp in stamps], dtype=torch.float32).flip(0)
        newest = boxes.flip(0)
        history = cls.begun(newest[-1:], ages[-1:], num_boxes)
        box = torch.cat((newest[:-1], history.box[0]))[:num_boxes]
        age = torch.cat((ages[:-1], history.age[0]))[:num_boxes]
        return cls(box=box[None], age=age[None])

    def advanced(self, box: Boxes, age: Scalars, is_new: Flags) -> "BoxHistory":
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

    boxes: BoxHistory  #: The last measured boxes of the object; those of a level camera for some methods.
    camera_pos: Vectors  #: Place of the calibrated camera, world frame [m].
    #: Position of the object's centre by a tracker, as old as the box, world frame [m]; for comparisons.
    object_pos: Vectors
    initial_object_pos: Vectors  #: The first such position of the episode [m].
    joint_pos: Joints  #: Joint encoders [rad].
    joint_pos_target: Joints  #: Joint targets commanded at this step [rad].
    #: Positions of the palms by forward kinematics of `joint_pos`, world frame [m].
    palm_pos: Float[Tensor, "num_envs num_palms 3"]
    #: Their orientations likewise, (w, x, y, z), with the sign of `robots.chain`.
    palm_quat: Float[Tensor, "num_envs num_palms 4"]
    action: Joints  #: Last actions of all agents in joint order, in [-1, 1].

    @property
    def box(self) -> Boxes:
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
    fingertip_pos: Float[Tensor, "num_envs num_fingers 3"]  #: True positions of fingertips, palm by palm [m].
    object_pos: Vectors  #: Position of the object's centre [m].
    object_lin_vel: Vectors  #: Its velocity [m/s].
    object_reach: Scalars  #: Distance from a palm under which it counts as reached [m].
    #: Which palms and fingers touched the object since the step before: each palm, then its fingers.
    is_touching: Bool[Tensor, "num_envs num_parts"]
    is_robot_on_table: Flags  #: Whether a robot touched the table since the step before.
    is_self_contact: Flags  #: Whether a robot touched itself, or another one, since the step before.
    is_robot_contact: Flags  #: Whether it touched another one since the step before.
    joint_vel: Joints  #: Joint speeds [rad/s].
    torque_share: Joints  #: Torques of the joints' servos as shares of their limits, without signs.


@dataclass(frozen=True, kw_only=True)
class Transition:
    """What one control step changed: the input of every reward and ending."""

    before: Privileged  #: The state before the action.
    now: Privileged  #: The state after it.
    action: Joints  #: The actions in joint order, in [-1, 1].
    joint_pos_target: Joints  #: The commanded joint targets [rad].
    held_steps: Counts  #: Consecutive control steps, this one included, with the object in the palm's reach.
    rested_steps: Counts  #: Control steps from the first success on, that one included; 0 before it.
    episode_steps: Counts  #: Control steps since the start of the episode, this one included.
    geometry: WorkcellGeometry  #: Forward kinematics of palms and arms.


@dataclass(frozen=True, kw_only=True)
class JointCommand:
    """How an action becomes a target: `anchor * position + offset + scale * action`, within the limits."""

    anchor: float  #: 1 if the action is relative to the measured position, 0 if it is absolute.
    offset: float  #: Target at action 0 of an absolute joint [rad].
    scale: float  #: Target change by action 1 [rad].
    lower: float  #: Lowest target [rad].
    upper: float  #: Highest target [rad].


def relative_command(joint: JointSpec) -> JointCommand:
    """Return targets relative to the measured position; action 1 is the speed limit in steady motion.

    A heavily damped servo with stiffness k and damping d moves at k / d times the distance of its command.
    The command ramps over the control step T, so at a steady speed v the target is v (d / k + T) ahead.

    Source: paper (added to the current joint positions); the scale is ours: the paper gives none.
    Differs: the release adds up to 0.05 rad to the previous target in each of four physics steps.
    """
    scale = joint.velocity_limit * (joint.damping / joint.stiffness + CONTROL_DT)
    return JointCommand(anchor=1.0, offset=0.0, scale=scale, lower=joint.lower, upper=joint.upper)


def absolute_command(joint: JointSpec) -> JointCommand:
    """Return targets over the whole range of the joint. Source: paper, Sec. IV-D."""
    middle, half_range = (joint.upper + joint.lower) / 2, (joint.upper - joint.lower) / 2
    return JointCommand(anchor=0.0, offset=middle, scale=half_range, lower=joint.lower, upper=joint.upper)


@dataclass(frozen=True)
class ActionMap:
    """The commands of all joints as rows of a tensor."""

    table: Float[Tensor, "5 num_joints"]  #: anchor, offset, scale, lower and upper, one row each.

    @classmethod
    def of(cls, commands: tuple[JointCommand, ...], device: torch.device) -> "ActionMap":
        """Stack the commands of joints in joint order."""
        rows = [(c.anchor, c.offset, c.scale, c.lower, c.upper) for c in commands]
        return cls(torch.tensor(rows, dtype=torch.float32, device=device).T.contiguous())

    def joint_pos_target(self, action: Joints, joint_pos: Joints) -> Joints:
        """Return joint targets [rad] of actions, which are clipped to [-1, 1]."""
        anchor, offset, scale, lower, upper = self.table
        target = anchor * joint_pos + offset + scale * action.clamp(-1.0, 1.0)
        return torch.clamp(target, lower, upper)


def merged(columns: Sequence[slice]) -> Columns:
    """Return the same columns, with adjacent slices joined."""
    whole: list[slice] = []
    for each in columns:
        if whole and whole[-1].stop == each.start:
            whole[-1] = slice(whole[-1].start, each.stop)
        elif each.stop > each.start:
            whole.append(each)
    return tuple(whole)


def take(
    values: Shaped[Tensor, "num_envs k *rest"], columns: Columns
) -> Shaped[Tensor, "num_envs num_columns *rest"]:
    """Return columns of a tensor, one after the other."""
    parts = [values[:, each] for each in columns]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def put(parts: Sequence[tuple[Columns, Tensor]]) -> Tensor:
    """Return the tensor with these parts as its columns: the inverse of `take`."""
    placed = []
    for columns, values in parts:
        pieces = values.split([each.stop - each.start for each in columns], dim=1)
        placed += [(each.start, piece) for each, piece in zip(columns, pieces, strict=True)]
    return torch.cat([piece for _, piece in sorted(placed, key=lambda each: each[0])], dim=1)
