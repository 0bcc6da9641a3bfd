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
    """Extremes over the physics steps of one control step."""

    #: Which palms and fingers touched the object: each palm, then its fingers.
    is_touching: Bool[Tensor, "num_envs num_parts"]
    is_robot_on_table: Bool[Tensor, " num_envs"]  #: Whether a robot touched the table.
    is_self_contact: Bool[Tensor, " num_envs"]  #: Whether a robot touched itself, or another one.
    penetration: Float[Tensor, " num_envs"]  #: Deepest overlap of the object with anything [m].
    table_penetration: Float[Tensor, " num_envs"]  #: Deepest overlap of a robot and the table [m].
    joint_speed: Float[Tensor, " num_envs"]  #: Largest speed of an arm joint [rad/s].
    torque_share: Float[Tensor, " num_envs"]  #: Largest joint torque, as a share of its limit.
    #: Mean torque of the hand's joints, as a share of their limits.
    hand_torque_share: Float[Tensor, " num_envs"]

    def cleared(self, mask: Bool[Tensor, " num_envs"]) -> "PhysicsLog":
        """The log without what happened in the masked environments."""
        return select(mask, PhysicsLog(*(torch.zeros_like(value) for value in self)), self)

    def merged(self, other: "PhysicsLog") -> "PhysicsLog":
        """Extremes of both: whether ever, and how much at most."""
        return PhysicsLog(*(torch.maximum(a, b) for a, b in zip(self, other, strict=True)))


class ContactColumns(NamedTuple):
    """Columns of `sensordata` with the numbers of contacts and the least distances."""

    found: slice  #: Numbers of contacts, a column a sensor.
    dist: slice  #: Least distances, likewise.
    touching: slice  #: Sensors of palms and fingers with the object, among those columns.
    anything: int  #: The sensor of the object with anything.
    table: slice  #: Sensors of the robots with the table.
    robots: slice  #: Sensors of the robots with themselves and each other.

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
