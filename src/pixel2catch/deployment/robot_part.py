"""One driver of the robot: between our joints and its messages."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from math import isfinite
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int

from pixel2catch.deployment import messages
from pixel2catch.deployment.messages import JointReading
from pixel2catch.deployment.schema import Sends
from pixel2catch.deployment.transport import Topic
from pixel2catch.errors import DeploymentError, InvalidValueError, UnknownNameError
from pixel2catch.robot.constants import JOINTS

NAMES = tuple(joint.name for joint in JOINTS)
"""Our names of the joints, in joint order."""

COMMANDS = (messages.FLOAT_ARRAY, messages.JOINT_STATE)
"""Types of the messages that take commands."""


@dataclass(frozen=True, kw_only=True)
class JointWire:
    """What a driver calls a joint.

    Attributes:
        name_in_state: Its name in the joint states.
        index_in_command: Its place in a command.
    """

    name_in_state: str
    index_in_command: int


@dataclass(frozen=True, kw_only=True)
class RobotPart:
    """One driver, of the arm or of the hand.

    Attributes:
        name: What it moves.
        joints: Its joints, by our names.
        state_topic: Topic of the joint states; another part may use it, too.
        command_topic: Topic of the commands, and the type that this driver takes.
        command_size: How many numbers a command has.
        held: Where joints are kept that are none of ours [rad], by their place in a command.
        rate_hz: How often the driver takes a command [Hz].
    """

    name: Literal["arm", "hand"]
    joints: dict[str, JointWire]
    state_topic: Annotated[Topic, Sends(messages.JOINT_STATE)]
    command_topic: Topic
    command_size: int
    held: dict[int, float] = field(default_factory=dict)
    rate_hz: float

    def __post_init__(self) -> None:
        """Refuse a part that would leave a number of its command to chance."""
        for joint in self.joints:
            if joint not in NAMES:
                raise UnknownNameError("joint", joint, NAMES)
        if self.command_topic.type not in COMMANDS:
            raise UnknownNameError("type of commands", self.command_topic.type, COMMANDS)
        wires = self.joints.values()
        require_once("the joint state's name", (wire.name_in_state for wire in wires))
        places = [*(wire.index_in_command for wire in wires), *self.held]
        require_once("the command's place", places)
        if sorted(places) != list(range(self.command_size)):
            raise InvalidValueError(
                f"a command has places 0 to {self.command_size - 1}, joints and held have {sorted(places)}: "
                "give each place one joint or one held angle"
            )
        if not (self.rate_hz > 0.0 and all(map(isfinite, self.held.values()))):
            raise InvalidValueError("rate_hz must be positive, and the held angles must be numbers")

    @cached_property
    def ids(self) -> Int[np.ndarray, " part_joints"]:
        """Places of its joints in joint order."""
        return np.array([NAMES.index(joint) for joint in self.joints], dtype=np.int64)

    @cached_property
    def _template(self) -> tuple[np.ndarray, np.ndarray]:
        """A command with the held angles in it, and the places of the joints."""
        values = np.zeros(self.command_size)
        values[list(self.held)] = list(self.held.values())
        return values, np.array([wire.index_in_command for wire in self.joints.values()], dtype=np.int64)

    def command(self, joint_pos_target: Float[np.ndarray, " num_joints"], stamp: float = 0.0) -> bytes:
        """Encode the command of this part.

        Args:
            joint_pos_target: Targets of all joints, in joint order [rad].
            stamp: When it is sent [s], for drivers that take joint states; these have no names then, as the
                drivers go by the order.
        """
        template, places = self._template
        values = template.copy()
        values[places] = joint_pos_target[self.ids]
        if self.command_topic.type == messages.JOINT_STATE:
            return messages.joint_state((), values, stamp)
        return messages.float_array(values)

    def merge(
        self, reading: JointReading, joint_pos: Float[np.ndarray, " num_joints"]
    ) -> Int[np.ndarray, " num_read"]:
        """Write those joints of this part that a joint state has into the positions of all; it may lack some.

        Args:
            reading: The joint state.
            joint_pos: Positions of all joints, in joint order [rad]; written into.

        Returns:
            Which of them were written.

        Raises:
            DeploymentError: It has one of them twice.
        """
        columns, ids = _columns(reading.names, self._wanted)
        joint_pos[ids] = reading.position[columns]
        return ids

    @cached_property
    def _wanted(self) -> tuple[tuple[str, int], ...]:
        return tuple((wire.name_in_state, NAMES.index(joint)) for joint, wire in self.joints.items())


@lru_cache(maxsize=64)
def _columns(names: tuple[str, ...], wanted: tuple[tuple[str, int], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Columns of a joint state that are wanted, and the joints that they are."""
    twice = sorted({name for name, _ in wanted if names.count(name) > 1})
    if twice:
        raise DeploymentError(f"a joint state has {', '.join(twice)} twice: look at what publishes it.")
    found = [(names.index(name), joint) for name, joint in wanted if name in names]
    columns, ids = np.array(found, dtype=np.int64).reshape(-1, 2).T
    return columns, ids


def require_once(what: str, values: Iterable[str | int]) -> None:
    """Refuse a value that is given twice.

    Raises:
        InvalidValueError: If one is.
    """
    values = list(values)
    twice = sorted({str(value) for value in values if values.count(value) > 1})
    if twice:
        raise InvalidValueError(f"{what} {', '.join(twice)} is given twice; give it once")
