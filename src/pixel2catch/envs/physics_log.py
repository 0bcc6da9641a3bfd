"""What happened within a control step: contacts and extremes over all of its physics steps."""

from typing import NamedTuple

import mujoco
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pixel2catch.mdp.masks import select
from pixel2catch.robots.workcell import WorkcellSpec
from pixel2catch.scene.scene import contact_sensors


class PhysicsLog(NamedTuple):
    """Extremes over the physics steps of one control step.

    Attributes:
        is_touching: Which palms and fingers touched the object: each palm, then its fingers.
        is_robot_on_table: Whether a robot touched the table.
        is_self_contact: Whether a robot touched itself, or another one.
        penetration: Deepest overlap of the object with anything [m].
        table_penetration: Deepest overlap of a robot and the table [m].
        joint_speed: Largest speed of an arm joint [rad/s].
        torque_share: Largest joint torque, as a share of its limit.
        hand_torque_share: Mean torque of the hand's joints, as a share of their limits.
    """

    is_touching: Bool[Tensor, "num_envs num_parts"]
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
    """Columns of `sensordata` with the numbers of contacts and the least distances.

    Attributes:
        found: Numbers of contacts, a column a sensor.
        dist: Least distances, likewise.
        touching: Sensors of palms and fingers with the object, among those columns.
        anything: The sensor of the object with anything.
        table: Sensors of the robots with the table.
        robots: Sensors of the robots with themselves and each other.
    """

    found: slice
    dist: slice
    touching: slice
    anything: int
    table: slice
    robots: slice

    @classmethod
    def of(cls, model: mujoco.MjModel, workcell: WorkcellSpec) -> "ContactColumns":
        """Find the columns; the sensors follow each other, two numbers each.

        Raises:
            ValueError: If the model's sensors are laid out otherwise.
        """
        names = [*contact_sensors(workcell)]
        addresses = [int(model.sensor(name).adr[0]) for name in names]
        first, last = addresses[0], addresses[-1] + 2
        if addresses != list(range(first, last, 2)):
            found = dict(zip(names, addresses, strict=True))
            raise ValueError(f"contact sensors are not consecutive pairs: {found}")
        anything, num_robots = names.index("object_any"), len(workcell.robots)
        return cls(
            found=slice(first, last, 2),
            dist=slice(first + 1, last, 2),
            touching=slice(0, anything),
            anything=anything,
            table=slice(anything + 1, anything + 1 + num_robots),
            robots=slice(anything + 1 + num_robots, len(names)),
        )
