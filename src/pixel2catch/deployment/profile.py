"""The robot profile: what a laboratory calls its topics and joints, and the order of its drivers."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pixel2catch.deployment import messages
from pixel2catch.deployment.messages import ImageReading
from pixel2catch.deployment.robot_part import RobotPart, require_once
from pixel2catch.deployment.schema import Sends, read_yaml
from pixel2catch.deployment.transport import Topic
from pixel2catch.errors import DeploymentError, UnknownNameError

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

    image: Annotated[Topic, Sends(messages.IMAGE)]
    info: Annotated[Topic, Sends(messages.CAMERA_INFO)] | None = None
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

    safety_mode: Annotated[Topic, Sends(messages.SAFETY_MODE, is_latched=True)] | None = None
    robot_mode: Annotated[Topic, Sends(messages.ROBOT_MODE, is_latched=True)] | None = None
    program_running: Annotated[Topic, Sends(messages.BOOLEAN, is_latched=True)] | None = None
    speed_scaling: Annotated[Topic, Sends(messages.NUMBER)] | None = None


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

    arm: Annotated[Topic, Sends(messages.BOOLEAN)] = field(default=_own("arm", messages.BOOLEAN))
    dead_man: Annotated[Topic, Sends(messages.BOOLEAN)] = field(default=_own("dead_man", messages.BOOLEAN))
    stop: Annotated[Topic, Sends(messages.BOOLEAN)] = field(default=_own("stop", messages.BOOLEAN))
    prompt: Annotated[Topic, Sends(messages.TEXT)] = field(default=_own("prompt", messages.TEXT))
    status: Annotated[Topic, Sends(messages.TEXT)] = field(default=_own("status", messages.TEXT))


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A robot with its drivers and its camera.

    Attributes:
        name: Its name.
        handedness: Which hand is on the arm.
        camera: The camera's driver.
        robots: The drivers of arm and hand.
        status: What the arm's driver says of itself.
        operator: Topics of the operator.
    """

    name: str
    handedness: Literal["left", "right"]
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
