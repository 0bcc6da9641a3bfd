"""The robot profile: names of topics and joints in a laboratory, and the order of its drivers.

It is a YAML file, whose schema are the dataclasses here. Errors name file, key and fix.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf, pi
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from jaxtyping import Float, Int
from msgspec import Meta

from pixel2catch.camera.image import Image
from pixel2catch.errors import DeploymentError, InvalidValueError, Pixel2CatchError, UnknownNameError
from pixel2catch.files import MOST_YAML, decoded, parse_yaml, read_text, reading, shown
from pixel2catch.ros2 import messages
from pixel2catch.ros2.messages import ENCODINGS
from pixel2catch.ros2.transport import Topic

if TYPE_CHECKING:
    from pixel2catch.robots.spec import JointSpec

PROFILES = Path(__file__).parent / "profiles"  #: The profiles that are shipped.
COMMANDS = (messages.FLOAT_ARRAY, messages.JOINT_STATE)  #: Types of messages that drivers take as commands.

LATCHED = {
    "activity": messages.ACTIVITY,
    "safety_mode": messages.SAFETY_MODE,
    "robot_mode": messages.ROBOT_MODE,
    "program_running": messages.BOOLEAN,
}
TOPICS = LATCHED | {
    "speed_scaling": messages.NUMBER,
    "state_topic": messages.JOINT_STATE,
    "image": messages.IMAGE,
    "info": messages.CAMERA_INFO,
    **dict.fromkeys(("arm", "dead_man", "stop"), messages.BOOLEAN),
    **dict.fromkeys(("prompt", "status"), messages.TEXT),
}
"""Type of the topics that have only a name in the file, by field; the latched ones."""


def _with_topics(content: Any, field: str = "") -> Any:
    """Replace the names of topics in the content of a file by all fields of `Topic`."""
    if isinstance(content, dict):
        return {key: _with_topics(value, key) for key, value in content.items()}
    if isinstance(content, list):
        return [_with_topics(value) for value in content]
    if field not in TOPICS or not isinstance(content, str):
        return content
    if not content.startswith("/"):
        fix = "write its full name, such as '/joint_states'"
        raise InvalidValueError(f"field '{field}': {shown(content)} is no topic; {fix}")
    return {"name": content, "type": TOPICS[field], "is_latched": field in LATCHED}


@dataclass(frozen=True, kw_only=True)
class DriverJoint:
    """A joint of a driver."""

    name_in_state: str  #: Its name in joint states.
    index_in_command: int  #: Its index in a command.


Limit = Annotated[float, Meta(gt=0.0)]
FARTHEST = 2.0 * pi  #: Largest angle of a held joint [rad]. Source: ours; no joint turns further.
Columns = Int[np.ndarray, " num_found"]


@dataclass(frozen=True, kw_only=True)
class MotionBudget:
    """A laboratory's limits of a part's motion, in addition to those of the servo."""

    speed: Limit = inf  #: Largest speed of a joint [rad/s].
    command_speed: Limit = inf  #: Largest speed of a command, which its joint need not reach [rad/s].
    acceleration: Limit = inf  #: Largest acceleration of a command [rad/s²].
    jerk: Limit = inf  #: Largest jerk of a command [rad/s³].
    step: Limit = inf  #: Change from one command to the next beyond which the driver ignores it [rad].
    #: Cycles of the driver in a row that may read no command; `step` limits the change over one more.
    missed_cycles: Annotated[int, Meta(ge=0)] = 0


@dataclass(frozen=True, kw_only=True)
class HeldJoint:
    """A driver joint that the work cell does not control. It is held at its angle."""

    angle: Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]  #: [rad].
    range: tuple[float, float] = (-FARTHEST, FARTHEST)  #: Lowest and highest angle of the joint [rad].
    #: Its name in joint states. Without it, the joint is not moved to its angle evenly, but at once.
    name_in_state: str | None = None

    def __post_init__(self) -> None:
        if not self.range[0] <= self.angle <= self.range[1]:
            lower, upper = self.range
            raise InvalidValueError(f"angle is {self.angle:g}; it may be {lower:g} to {upper:g} rad")


@dataclass(frozen=True, kw_only=True)
class StatusTopics:
    """Status topics of an arm's driver; one that is left out is not checked."""

    safety_mode: Topic | None = None
    robot_mode: Topic | None = None
    program_running: Topic | None = None
    speed_scaling: Topic | None = None  #: [%].


@dataclass(frozen=True, kw_only=True)
class Controller:
    """The controller of ros2_control that takes the commands."""

    name: str  #: Such as forward_position_controller; it must be active.
    activity: Topic  #: Topic of its controller manager with the states of all controllers, from Jazzy on.


@dataclass(frozen=True, kw_only=True)
class RobotPart:
    """The driver of one joint group of the work cell. `Profile` checks it."""

    name: str  #: The joint group, such as "arm" or "hand".
    joints: dict[str, DriverJoint]  #: Its joints, by their names in the work cell.
    state_topic: Topic  #: Joint states; parts may share the topic.
    command_topic: Topic  #: Commands, of a type in `COMMANDS`.
    command_size: int  #: Number of values in a command.
    held: dict[int, HeldJoint] = field(default_factory=dict)  #: Held joints, by their index in a command.
    rate_hz: Limit  #: Rate at which the driver takes commands [Hz].
    limits: MotionBudget = MotionBudget()
    controller: Controller | None = None  #: Not checked if absent.
    status: StatusTopics | None = None  #: Of a further arm; the first arm's is the profile's.
    notice: str = ""  #: What its driver does that an operator must expect; said before anything is sent.
    joint_order: tuple[str, ...] = ()  #: All joints of the work cell; the profile fills it in.

    def require_complete(self) -> None:
        """Refuse a part whose command is not fully defined."""
        for joint in self.joints:
            if joint not in self.joint_order:
                raise UnknownNameError("joint", joint, self.joint_order)
        if self.command_topic.type not in COMMANDS:
            raise UnknownNameError("type of commands", self.command_topic.type, COMMANDS)
        everyone = (*self.joints.values(), *self.held.values())
        names = [each.name_in_state for each in everyone if each.name_in_state]
        _require_once("the joint state's name", names)
        places = sorted((*self._places[0].tolist(), *self.held))
        _require_once("the command's place", places)
        if places != list(range(self.command_size)):
            places_of = f"a command has places 0 to {self.command_size - 1}, joints and held have {places}"
            raise InvalidValueError(f"{places_of}: give each place one joint or one held angle")

    @cached_property
    def ids(self) -> Int[np.ndarray, " part_joints"]:
        """Indices of its joints in joint order."""
        return np.array([self.joint_order.index(joint) for joint in self.joints], dtype=np.int64)

    @cached_property
    def held_angles(self) -> Float[np.ndarray, " num_held"]:
        """Angles of the held joints [rad]."""
        return np.array([joint.angle for joint in self.held.values()])

    @cached_property
    def _places(self) -> tuple[Int[np.ndarray, " part_joints"], Int[np.ndarray, " num_held"]]:
        places = [joint.index_in_command for joint in self.joints.values()]
        return np.array(places, dtype=np.int64), np.array([*self.held], dtype=np.int64)

    def command(
        self,
        joint_pos: Float[np.ndarray, " num_joints"],
        held: Float[np.ndarray, " num_held"],
        stamp: float = 0.0,
    ) -> bytes:
        """Encode positions in joint order, and those of the held joints [rad]; joint states have no names."""
        values, (places, held_places) = np.empty(self.command_size), self._places
        values[places], values[held_places] = joint_pos[self.ids], held
        if self.command_topic.type == messages.JOINT_STATE:
            return messages.joint_state((), values, stamp)
        return messages.float_array(values)

    def columns(self, names: tuple[str, ...]) -> tuple[Columns, Columns]:
        """Return the columns of a joint state with these names that are its joints, and their `ids`.

        Raises DeploymentError if it has one of them twice.
        """
        return _columns(names, [joint.name_in_state for joint in self.joints.values()], self.ids)

    def held_columns(self, names: tuple[str, ...]) -> tuple[Columns, Columns]:
        """Return the columns of its held joints, and their places among these; raises as `columns` does."""
        return _columns(names, [joint.name_in_state for joint in self.held.values()], range(len(self.held)))


def _columns(
    names: tuple[str, ...], wanted: Iterable[str | None], places: Iterable[int]
) -> tuple[Columns, Columns]:
    found = {name: place for name, place in zip(wanted, places, strict=True) if name in names}
    if twice := sorted(name for name in found if names.count(name) > 1):
        raise DeploymentError(f"a joint state has {', '.join(twice)} twice: check what publishes it.")
    columns = np.array([names.index(name) for name in found], dtype=np.int64)
    return columns, np.array([*found.values()], dtype=np.int64)


def _require_once(what: str, values: Sequence[str | int]) -> None:
    if twice := sorted({str(value) for value in values if values.count(value) > 1}):
        raise InvalidValueError(f"{what} {', '.join(twice)} is given twice; give it once")


@dataclass(frozen=True, kw_only=True)
class CameraProfile:
    """The camera's driver."""

    image: Topic  #: Topic of the images.
    info: Topic | None = None  #: Topic of the lens, if any.
    width: int  #: Image width [px].
    height: int  #: Image height [px].
    #: Of its images, one of `messages.ENCODINGS`.
    encoding: Annotated[str, Meta(pattern=f"^({'|'.join(ENCODINGS)})$")] = "rgb8"
    #: Time from the middle of the exposure of the middle row to the stamp [s]; `calibrate --timing`.
    stamp_offset: Annotated[float, Meta(ge=-0.1, le=0.1)] = 0.0
    #: Time from the first row to the last of a rolling shutter [s]; `calibrate --timing`.
    readout_time: Annotated[float, Meta(ge=-0.05, le=0.05)] = 0.0

    def wrong_format(self, image: Image) -> str:
        """Return the error of an image of another size or encoding; empty if it has the profile's."""
        height, width, _ = image.pixels.shape
        found, ours = f"{width} x {height} {image.encoding}", f"{self.width} x {self.height} {self.encoding}"
        wrong = f"{self.image.name} sends {found}, the profile says {ours}: set the camera's driver to that."
        return "" if found == ours else wrong


_OWN = {
    name: Topic(name=f"/pixel2catch/{name}", type=TOPICS[name])
    for name in ("arm", "dead_man", "stop", "prompt", "status")
}


@dataclass(frozen=True, kw_only=True)
class OperatorTopics:
    """Topics between operator and deployment."""

    arm: Topic = _OWN["arm"]  #: Requests to arm.
    dead_man: Topic = _OWN["dead_man"]  #: Whether the dead-man's switch is held.
    stop: Topic = _OWN["stop"]  #: Requests to stop.
    prompt: Topic = _OWN["prompt"]  #: Where the object is in an image.
    status: Topic = _OWN["status"]  #: Status of the deployment.


@dataclass(frozen=True, kw_only=True)
class Place:
    """A place over which the hand releases what it holds."""

    joints: dict[str, float]  #: Arm joints by their names [rad]; others are at the start pose.

    def require_valid(self, name: str, arm: Mapping[str, "JointSpec"]) -> None:
        """Refuse joints that no arm has, and angles out of range."""
        for joint, angle in self.joints.items():
            if joint not in arm:
                raise UnknownNameError("arm joint", joint, arm)
            lower, upper = arm[joint].lower, arm[joint].upper
            if not lower <= angle <= upper:
                wrong = f"{joint} is {angle:g}; it may be {lower:g} to {upper:g} rad"
                raise InvalidValueError(f"places.{name}: {wrong}")


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A robot with its drivers and its camera."""

    name: str
    workcell: str  #: Name of the work cell; of a file of the user's after `--import FILE.py` only.
    camera: CameraProfile
    robots: tuple[RobotPart, ...]  #: A driver for each joint group.
    status: StatusTopics = StatusTopics()
    operator: OperatorTopics = OperatorTopics()
    places: dict[str, Place] = field(default_factory=dict)  #: Places to release an object over, by name.

    def __post_init__(self) -> None:
        """Fill in the joint order; refuse joints that are not in the work cell, or driven twice."""
        from pixel2catch.workcells import find_workcell  # needs MuJoCo: not where a profile is unpickled

        workcell = find_workcell(self.workcell)
        order = tuple(joint.name for joint in workcell.joints)
        parts = tuple(replace(part, joint_order=order) for part in self.robots)
        object.__setattr__(self, "robots", parts)
        groups = [group.name for group in workcell.groups]
        for i, part in enumerate(parts):
            try:
                if part.name not in groups:
                    raise UnknownNameError("joint group", part.name, groups)
                part.require_complete()
            except Pixel2CatchError as error:
                raise InvalidValueError(f"robots[{i}]: {error}") from error
        arm = {each.name: each for group in workcell.groups if group.role == "arm" for each in group.joints}
        for name, place in self.places.items():
            place.require_valid(name, arm)
        _require_once("the joint", [joint for part in parts for joint in part.joints])
        _require_once("the command topic", [part.command_topic.name for part in parts])

    @classmethod
    def load(cls, name_or_path: str | Path) -> "Profile":
        """Read a shipped profile by its name, or a .yaml file by its path, or raise DeploymentError."""
        path = profile_file(name_or_path)
        with reading("profile", path, "Correct it.", DeploymentError):
            return decoded(cls, _with_topics(parse_yaml(read_text(path, MOST_YAML))))

    @property
    def all_status(self) -> list[dict[str, Topic]]:
        """Status topics of each arm by their fields, without those that are not checked."""
        every = (self.status, *(part.status for part in self.robots if part.status))
        return [{name: topic for name, topic in vars(each).items() if topic} for each in every]

    @property
    def driver_topics(self) -> set[Topic]:
        """Topics that the robot's drivers send: joint states and status."""
        controllers = {part.controller.activity for part in self.robots if part.controller}
        states = {part.state_topic for part in self.robots}
        return states | controllers | {topic for status in self.all_status for topic in status.values()}

    def require(self, joints: Iterable[str]) -> None:
        """Refuse a policy that moves joints which this robot does not have, by a `DeploymentError`."""
        ours = {joint for part in self.robots for joint in part.joints}
        if missing := [joint for joint in joints if joint not in ours]:
            fix = "add them to the joints of a part, or use a policy for this robot"
            wrong = f"profile '{self.name}' has no {', '.join(missing)}, which the policy moves"
            raise DeploymentError(f"{wrong}: {fix}.")


def profile_file(name_or_path: str | Path) -> Path:
    """Return the file of a shipped profile, or the path of a .yaml file, or raise UnknownNameError."""
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        return path
    shipped = {file.stem: file for file in sorted(PROFILES.glob("*.yaml"))}
    if str(name_or_path) not in shipped:
        raise UnknownNameError("profile", str(name_or_path), [*shipped, "a .yaml file of yours"])
    return shipped[str(name_or_path)]
