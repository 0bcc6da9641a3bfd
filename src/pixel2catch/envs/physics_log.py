"""What happened within a control step: contacts and extremes over all of its physics steps."""

from typing import NamedTuple

import mujoco
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.mdp.masks import select
from pixel2catch.mdp.snapshot import HAND_PARTS

SENSORS = (*(f"object_{part}" for part in HAND_PARTS), "object_any", "robot_table", "robot_self")
"""Contact sensors of the model, in order; each gives the number of contacts found and the least distance."""


class PhysicsLog(NamedTuple):
    """Extremes over the physics steps of one control step.

    Attributes:
        is_touching: Which of `HAND_PARTS` touched the object.
        is_robot_on_table: Whether the robot touched the table.
        is_self_contact: Whether the robot touched itself.
        penetration: Deepest overlap of the object with anything [m].
        table_penetration: Deepest overlap of robot and table [m].
        joint_speed: Largest speed of an arm joint [rad/s].
        torque_share: Largest joint torque, as a share of its limit.
        hand_torque_share: Mean torque of the hand's joints, as a share of their limits.
    """

    is_touching: Bool[Tensor, "num_envs 5"]
    is_robot_on_table: Bool[Tensor, " num_envs"]
    is_self_contact: Bool[Tensor, " num_envs"]
    penetration: Float[Tensor, " num_envs"]
    table_penetration: Float[Tensor, " num_envs"]
    joint_speed: Float[Tensor, " num_envs"]
    torque_share: Float[Tensor, " num_envs"]
    hand_torque_share: Float[Tensor, " num_envs"]

    def cleared(self, mask: Bool[Tensor, " num_envs"]) -> "PhysicsLog":
        """The log without what happened in the masked environments."""
        return select(mask, PhysicsLog(*(torch.zeros_like(value) for value in self)), self)

    def merged(self, other: "PhysicsLog") -> "PhysicsLog":
        """Extremes of both: whether ever, and how much at most."""
        return PhysicsLog(*(torch.maximum(a, b) for a, b in zip(self, other, strict=True)))


class ContactColumns(NamedTuple):
    """Columns of `sensordata` with the numbers of contacts and the least distances, in order of `SENSORS`."""

    found: slice
    dist: slice

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "ContactColumns":
        """Find the columns; the sensors follow each other, two numbers each.

        Raises:
            ValueError: If the model's sensors are laid out otherwise.
        """
        addresses = [int(model.sensor(name).adr[0]) for name in SENSORS]
        first, last = addresses[0], addresses[-1] + 2
        if addresses != list(range(first, last, 2)):
            found = dict(zip(SENSORS, addresses, strict=True))
            raise ValueError(f"contact sensors are not consecutive pairs: {found}")
        return cls(found=slice(first, last, 2), dist=slice(first + 1, last, 2))
