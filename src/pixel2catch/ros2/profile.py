"""The robot profile: what a laboratory calls its topics and joints, and the order of its drivers."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from math import isfinite
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int

from pixel2catch.errors import DeploymentError, InvalidValueError, UnknownNameError
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import ImageReading, JointReading
from pixel2catch.ros2.schema import TopicType, read_yaml
from pixel2catch.ros2.transport import Topic
from pixel2catch.scene.constants import JOINTS

NAMES = tuple(joint.name for joint in JOINTS)
"""Our names of the joints, in joint order."""

COMMANDS = (messages.FLOAT_ARRAY, messages.JOINT_STATE)
"""Types of the messages that take commands."""


@dataclass(frozen=True, kw_only=True)
class DriverJoint:
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
    joints: dict[str, DriverJoint]
    state_topic: Annotated[Topic, TopicType(messages.JOINT_STATE)]
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
        all_theirs = self.joints.values()
        require_once("the joint state's name", (theirs.name_in_state for theirs in all_theirs))
        places = [*(theirs.index_in_command for theirs in all_theirs), *self.held]
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
        return values, np.array([theirs.index_in_command for theirs in self.joints.values()], dtype=np.int64)

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
        return tuple((theirs.name_in_state, NAMES.index(joint)) for joint, theirs in self.joints.items())


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


PROFILES = Path(__file__).parent / "profiles"
"""The profiles that are shipped."""


@dataclass(frozen=True, kw_only=True)
class CameraProfile:
    """The camera's driver.

    Attributes:
        image: Topic of the images.
        info: Topic of the lens, if there is one.
        width: Image width [px].
        height: Image height [px].
        encoding: Encoding of the images.
    """

    image: Annotated[Topic, TopicType(messages.IMAGE)]
    info: Annotated[Topic, TopicType(messages.CAMERA_INFO)] | None = None
    width: int
    height: int
    encoding: Literal["rgb8", "bgr8"] = "rgb8"

    def require(self, reading: ImageReading) -> None:
        """Refuse an image of another size or encoding.

        Raises:
            DeploymentError: If it is one.
        """
        height, width, _ = reading.pixels.shape
        if (width, height, reading.encoding) != (self.width, self.height, self.encoding):
            raise DeploymentError(
                f"{self.image.name} sends {width} x {height} {reading.encoding}, the profile says "
                f"{self.width} x {self.height} {self.encoding}: set the camera's driver to that."
            )


@dataclass(frozen=True, kw_only=True)
class StatusTopics:
    """What the arm's driver says of itself; what is left out is not watched.

    Attributes:
        safety_mode: Topic of the safety mode.
        robot_mode: Topic of the robot's mode.
        program_running: Topic that says whether the driver's program runs.
        speed_scaling: Topic of the speed scaling [%].
    """

    safety_mode: Annotated[Topic, TopicType(messages.SAFETY_MODE, is_latched=True)] | None = None
    robot_mode: Annotated[Topic, TopicType(messages.ROBOT_MODE, is_latched=True)] | None = None
    program_running: Annotated[Topic, TopicType(messages.BOOLEAN, is_latched=True)] | None = None
    speed_scaling: Annotated[Topic, TopicType(messages.NUMBER)] | None = None


def _own(name: str, message: str) -> Topic:
    return Topic(name=f"/pixel2catch/{name}", type=message)


@dataclass(frozen=True, kw_only=True)
class OperatorTopics:
    """Our own topics, between the operator and the deployment.

    Attributes:
        arm: The operator asks to arm.
        dead_man: The operator holds the dead-man's switch.
        stop: The operator stops.
        prompt: The operator points at the object.
        status: What the deployment does.
    """

    arm: Annotated[Topic, TopicType(messages.BOOLEAN)] = field(default=_own("arm", messages.BOOLEAN))
    dead_man: Annotated[Topic, TopicType(messages.BOOLEAN)] = field(
        default=_own("dead_man", messages.BOOLEAN)
    )
    stop: Annotated[Topic, TopicType(messages.BOOLEAN)] = field(default=_own("stop", messages.BOOLEAN))
    prompt: Annotated[Topic, TopicType(messages.TEXT)] = field(default=_own("prompt", messages.TEXT))
    status: Annotated[Topic, TopicType(messages.TEXT)] = field(default=_own("status", messages.TEXT))


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A robot with its drivers and its camera.

    Attributes:
        name: Its name.
        workcell: Name of the work cell whose robot it is.
        camera: The camera's driver.
        robots: The drivers of arm and hand.
        status: What the arm's driver says of itself.
        operator: Topics of the operator.
    """

    name: str
    workcell: str
    camera: CameraProfile
    robots: tuple[RobotPart, ...]
    status: StatusTopics = StatusTopics()
    operator: OperatorTopics = OperatorTopics()

    def __post_init__(self) -> None:
        """Refuse two drivers for one joint or on one topic."""
        require_once("the joint", (joint for part in self.robots for joint in part.joints))
        require_once("the command topic", (part.command_topic.name for part in self.robots))

    @classmethod
    def load(cls, name_or_path: str | Path) -> "Profile":
        """Read a shipped profile by its name, or a file.

        Args:
            name_or_path: The name, or the path of a .yaml file.

        Raises:
            UnknownNameError: There is no such profile.
            DeploymentError: The file cannot be read, or is no profile; the message names the key and the fix.
        """
        path = Path(name_or_path)
        if path.suffix in (".yaml", ".yml"):
            return read_yaml(path, cls)
        shipped = {file.stem: file for file in sorted(PROFILES.glob("*.yaml"))}
        if str(name_or_path) not in shipped:
            raise UnknownNameError("profile", str(name_or_path), [*shipped, "a .yaml file of yours"])
        return read_yaml(shipped[str(name_or_path)], cls)

    def require(self, joints: Iterable[str]) -> None:
        """Refuse a policy that moves joints which this robot does not have.

        Args:
            joints: Our names of the policy's joints.

        Raises:
            DeploymentError: Some are missing; the message names them.
        """
        missing = [joint for joint in joints if not any(joint in part.joints for part in self.robots)]
        if missing:
            raise DeploymentError(
                f"profile '{self.name}' has no {', '.join(missing)}, which the policy moves: add them to the "
                "joints of a part, or take a policy for this robot."
            )
