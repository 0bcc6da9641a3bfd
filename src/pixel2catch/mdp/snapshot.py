"""One control step as data: what the robot can measure, what only the simulator knows, and what changed.

Policy inputs are computed from `Measurement` alone; value networks and rewards may also see `Privileged`.
The split is a type, so that no policy can be given what a real robot does not have.
"""

from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor

from pixel2catch.mdp.box_history import BoxHistory
from pixel2catch.robots.geometry import WorkcellGeometry


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What the robot knows at one control step, in simulation and in the laboratory.

    Attributes:
        boxes: The last measured bounding boxes of the object, as many as the method remembers.
        object_pos: Position of the object's centre by a tracker, as old as the box, world frame [m]. Only
            methods that others are compared with read it.
        initial_object_pos: The first such position of the episode [m].
        joint_pos: Joint encoders [rad].
        joint_pos_target: Joint targets commanded at this step [rad].
        palm_pos: Positions of the palms by forward kinematics of `joint_pos`, world frame [m].
        palm_quat: Their orientations likewise, (w, x, y, z), with the sign of `robots.chain`.
        action: Last actions of all agents in joint order, in [-1, 1].
    """

    boxes: BoxHistory
    object_pos: Float[Tensor, "num_envs 3"]
    initial_object_pos: Float[Tensor, "num_envs 3"]
    joint_pos: Float[Tensor, "num_envs num_joints"]
    joint_pos_target: Float[Tensor, "num_envs num_joints"]
    palm_pos: Float[Tensor, "num_envs num_palms 3"]
    palm_quat: Float[Tensor, "num_envs num_palms 4"]
    action: Float[Tensor, "num_envs num_joints"]

    @property
    def box(self) -> Float[Tensor, "num_envs 4"]:
        """Newest measured box of the object: xmin, ymin, xmax, ymax [px]."""
        return self.boxes.box[:, 0]


class History(NamedTuple):
    """Three consecutive measurements: two frames, each with a difference to the step before it."""

    oldest: Measurement
    before: Measurement
    now: Measurement


@dataclass(frozen=True, kw_only=True)
class Privileged:
    """What only the simulator knows at one control step (world frame).

    Attributes:
        palm_pos: True positions of the palms [m].
        fingertip_pos: True positions of the fingertips, palm by palm [m].
        object_pos: Position of the object's centre [m].
        object_lin_vel: Its velocity [m/s].
        is_touching: Which palms and fingers touched the object since the step before: each palm, then its
            fingers.
        is_robot_on_table: Whether a robot touched the table since the step before.
        is_self_contact: Whether a robot touched itself, or another one, since the step before.
        joint_vel: Joint speeds [rad/s].
    """

    palm_pos: Float[Tensor, "num_envs num_palms 3"]
    fingertip_pos: Float[Tensor, "num_envs num_fingers 3"]
    object_pos: Float[Tensor, "num_envs 3"]
    object_lin_vel: Float[Tensor, "num_envs 3"]
    is_touching: Bool[Tensor, "num_envs num_parts"]
    is_robot_on_table: Bool[Tensor, " num_envs"]
    is_self_contact: Bool[Tensor, " num_envs"]
    joint_vel: Float[Tensor, "num_envs num_joints"]


@dataclass(frozen=True, kw_only=True)
class Transition:
    """What one control step changed: the input of every reward and ending.

    Attributes:
        before: The state that the actions were chosen in.
        now: The state that they led to.
        action: The actions in joint order, in [-1, 1].
        joint_pos_target: The joint targets that they commanded [rad].
        held_steps: Consecutive control steps, this one included, with the object in the palm's reach.
        episode_steps: Control steps since the start of the episode, this one included.
        geometry: Where palms and arms are for given joint positions.
    """

    before: Privileged
    now: Privileged
    action: Float[Tensor, "num_envs num_joints"]
    joint_pos_target: Float[Tensor, "num_envs num_joints"]
    held_steps: Int[Tensor, " num_envs"]
    episode_steps: Int[Tensor, " num_envs"]
    geometry: WorkcellGeometry
